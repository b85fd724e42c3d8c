# perilune: datasets, networks and their explanation. `make help` lists the targets.
SHELL := /bin/bash
PYTHON ?= python3.11
# `make demo` has its own default preset.
PRESET ?= $(if $(filter demo,$(MAKECMDGOALS)),demo,small)
KIND ?= both
NAME ?= $(PRESET)
VENV := .venv
BIN := $(VENV)/bin

# OUT is the folder of the target's output: datasets for `make dataset`, runs for the others.
DATA := data/$(PRESET)
RUNS := runs
ifneq ($(OUT),)
  ifneq ($(filter dataset,$(MAKECMDGOALS)),)
    DATA := $(OUT)
  else
    RUNS := $(OUT)
  endif
endif

# Quote a value as one argument of a shell command.
quoted = '$(subst ','\'',$(1))'
# SET is split into shell words, so quotes keep a value with spaces together.
SETTINGS := $(if $(SET),$(shell set -f; for setting in $(SET); do \
  [[ $$setting == *.*=* ]] || exit 2; printf -- '--set %q ' "$$setting"; done))
ifneq ($(if $(SET),$(.SHELLSTATUS),0),0)
  $(error SET: got $(SET), expected shell words: SET="a.b=1 'c.d={low: 0, high: 1}'")
endif

COMMON := --preset $(PRESET) $(if $(CONFIG),--config $(call quoted,$(CONFIG))) $(SETTINGS)
TRAIN := $(COMMON) --out $(call quoted,$(RUNS)) --name $(NAME)
RENDER = $(BIN)/perilune-render dataset $(COMMON) $(if $(DEM),--dem $(call quoted,$(DEM))) \
  $(if $(CATALOGUE),--catalogue $(call quoted,$(CATALOGUE))) \
  $(if $(WORKERS),--workers $(WORKERS)) $(if $(THREADS),--threads $(THREADS)) \
  $(if $(EXECUTOR),--executor $(EXECUTOR)) $(if $(ADDRESS),--address $(ADDRESS)) --out $(call quoted,$(DATA))

DETECT := $(RUNS)/detect/$(NAME)/metrics.json
NAVIGATE := $(RUNS)/navigate/$(NAME)/metrics.json

.DEFAULT_GOAL := help
.PHONY: help setup setup-dev bench bench-nac demo dataset benchmark benchmark-nav benchmark-landing benchmark-frames paper train-detect train-detect-baseline ablate-detect compare-detectors train-nav train-nav-baseline navigate navigate-map navigate-monte-carlo explain explain-causal report closed-loop test test-hostile coverage lint docs docs-build bench-render bench-kill bench-scale bench-requests bench-scaling compare-nac bench-terrain bench-megapixel bench-photometry bench-develop bench-regenerate bench-same-bytes bench-manifest bench-plan bench-memory bench-labels bench-lens-labels bench-truth bench-contrast bench-train bench-transfer bench-landing bench-motion bench-learned-alignment bench-monte-carlo bench-stream bench-fresh bench-suppress bench-robust bench-alarms bench-suspect bench-gates bench-engines bench-gpu bench-other-ground bench-profile bench-serve bench-infer bench-latency bench-paper-causes bench-captured bench-pose-limits bench-shared results assurance traces trace-inputs release clean

# `##@ Title` begins a group of targets; `##` describes a target.
help: ## list these targets
	@awk -F ':[^#]*## ' '/^##@ / { printf "\n%s\n", substr($$0, 5) } /^[a-z-]+:[^#]*## / { printf "  %-22s%s\n", $$1, $$2 }' $(MAKEFILE_LIST)
	@echo
	@echo 'PRESET=tiny|demo|small|paper|large  CONFIG=file.yaml  OUT=folder  SET="a.b=c d.e=f"  NAME=run  OVERWRITE=1'
	@echo 'DEM=file.tif  CATALOGUE=file.csv  WORKERS=processes  THREADS=threads  EXECUTOR=local|ray  ADDRESS=host:port'
	@echo
	@echo "SET takes settings as shell words; quote a setting that contains spaces or quotes:"
	@echo "  make dataset SET=\"dataset.seed=7 'dataset.detect.sun.elevation_deg={low: 5, high: 9}'\""

##@ Start
setup: $(VENV)/.ready ## create the environment (.venv) with all packages

$(VENV)/.ready: constraints.txt pyproject.toml shared/pyproject.toml render/pyproject.toml train/pyproject.toml perilune/pyproject.toml scripts/system-libraries
	@command -v $(PYTHON) >/dev/null || { echo "$(PYTHON): not found: Blender's module needs Python 3.11 (sudo apt-get install -y python3.11 python3.11-venv)" >&2; exit 2; }
	@scripts/system-libraries
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@$(BIN)/python -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' || { echo "$(VENV): got $$($(BIN)/python -V), expected Python 3.11, which Blender's module needs: type  mv $(VENV) $(VENV)-old  and then  make setup PYTHON=python3.11" >&2; exit 2; }
	@echo "installing into $(VENV) (some minutes the first time)"
	@$(BIN)/python -m pip install -q -c constraints.txt setuptools wheel torch
	@$(BIN)/python -m pip install -q -c constraints.txt --no-build-isolation -e shared -e "render[blender]" -e "train[geo]" -e perilune
	@touch $@

setup-dev: $(VENV)/.ready-dev # also install the tools of tests, checks, documentation and benchmarks

$(VENV)/.ready-dev: $(VENV)/.ready requirements-dev.txt
	@scripts/system-libraries --browser
	@echo "installing tools for development into $(VENV)"
	@$(BIN)/python -m pip install -q -c constraints.txt --no-build-isolation -e "shared[mcap,rerun]" -e "train[export,geo]" -r requirements-dev.txt
	@touch $@

demo: setup ## run all steps on small data: frames, detection, navigation, explanation, report (PRESET=demo; PRESET=tiny only tests that all steps run)
	@$(BIN)/python scripts/demo.py --preset $(PRESET) --name $(NAME) --data $(call quoted,$(DATA)) --runs $(call quoted,$(RUNS)) \
	  $(if $(DEM),--dem $(call quoted,$(DEM))) $(if $(CATALOGUE),--catalogue $(call quoted,$(CATALOGUE))) $(if $(CONFIG),--config $(call quoted,$(CONFIG))) $(SETTINGS)
	@echo
	@echo "Datasets    $(DATA)/detect  $(DATA)/nav           pictures: overview.png"
	@echo "Detection   $(RUNS)/detect/$(NAME)                metrics.json, *.png, detections.parquet"
	@echo "Navigation  $(RUNS)/navigate/$(NAME)-stack        metrics.json, *.png, navigation.parquet"
	@echo "Landing     $(RUNS)/navigate/$(NAME)-landing      monte_carlo.md, *.png: the filter over the test descents"
	@echo "Explanation $(RUNS)/explain/$(NAME)               claims.json, metrics.json, *.png, *.parquet"
	@echo "Report      $(RUNS)/report/$(NAME)                report.html (open it in a browser), summary.md"

##@ Datasets and training
dataset: setup ## render the preset's datasets (KIND=detect|nav for only one); run again to resume
	@$(RENDER) --kind $(KIND)

# An interrupted rendering has a dataset.json too; the command then resumes it.
.PHONY: detect-frames nav-frames
detect-frames: setup
	@grep -qs '"complete": true' "$(DATA)/detect/dataset.json" || $(RENDER) --kind detect
nav-frames: setup
	@grep -qs '"complete": true' "$(DATA)/nav/dataset.json" || $(RENDER) --kind nav

# OVERWRITE=1 replaces the runs of the targets named on the command line, and no others.
OVER = $(if $(OVERWRITE),$(if $(filter $@,$(MAKECMDGOALS)),--overwrite))
.PHONY: train
train:
	@echo "make train: got no task, expected make train-detect (craters) or make train-nav (navigation)" >&2; exit 2

train-detect: detect-frames ## train and evaluate crater detection; run again to resume (OVERWRITE=1 replaces)
	@$(BIN)/perilune-train detect train $(TRAIN) --dataset "$(DATA)/detect" $(OVER)

train-detect-baseline: detect-frames # the same network without attention, into <name>-none
	@$(BIN)/perilune-train detect train $(COMMON) --set detect.attention=none --out "$(RUNS)" --name $(NAME)-none --dataset "$(DATA)/detect" $(OVER)

# Runs <name>-<change> have the seeds of <name>, the run of train-detect, and one changed setting each.
ABLATION ?= none:attention=none cbam:attention=cbam identity:attention=cbam_identity unguided:loss.lambda_guide=0 strides-8:strides=[8,16,32] width-0.25:width=0.25 width-1:width=1.0
ABLATED = "$(RUNS)/detect/$(NAME)" $(foreach one,$(ABLATION),"$(RUNS)/detect/$(NAME)-$(firstword $(subst :, ,$(one)))")
ablate-detect: train-detect ## train variants of the detector (attention, guidance, strides, widths), and compare them
	@$(foreach one,$(ABLATION),$(BIN)/perilune-train detect train $(COMMON) --set detect.$(lastword $(subst :, ,$(one))) \
	  --out "$(RUNS)" --name $(NAME)-$(firstword $(subst :, ,$(one))) --dataset "$(DATA)/detect" $(OVER) &&) true
	@$(BIN)/perilune-train detect compare $(ABLATED) --out "$(RUNS)/detect/$(NAME)-ablation"
	@$(BIN)/python -m benchmarks.train.size $(ABLATED) --out "$(RUNS)/detect/$(NAME)-ablation"

compare-detectors: setup-dev train-detect train-detect-baseline ## train RT-DETRv2 on the same frames, and compare it with YOLOv3 with and without attention; run again to resume
	@$(BIN)/python -m benchmarks.train.compare_detectors "$(DATA)/detect" "$(RUNS)/detect/$(NAME)" "$(RUNS)/detect/$(NAME)-none" \
	  --out "$(RUNS)/compare/$(NAME)" $(OVER)

train-nav: nav-frames ## train and evaluate navigation (warp and stack)
	@test -f "$(DETECT)" || $(MAKE) --no-print-directory OVERWRITE= train-detect
	@$(BIN)/perilune-train navigate train $(TRAIN) --dataset "$(DATA)/nav" $(OVER)

# Each network without attention; the stack network starts from the detector without attention, if there is one.
train-nav-baseline: nav-frames # the same networks without attention, into <name>-none and <name>-none-stack
	@$(BIN)/perilune-train navigate train $(COMMON) --set navigate.warp.attention=none --set navigate.stack.attention=none \
	  --out $(call quoted,$(RUNS)) --name $(NAME)-none --dataset "$(DATA)/nav" $(OVER)

##@ Landing
METHODS := $(RUNS)/navigate/$(NAME)-methods
MAP := $(RUNS)/navigate/$(NAME)-map

# $(1): dataset, $(2): split, $(3): folder of the survey, $(4): folder of the map.
define surveyed
{ test -e "$(3)-plan/dataset.json" || $(BIN)/perilune-manifest subset "$(1)" --out "$(3)-plan" --images none --where "split == '$(2)'"; } && \
$(BIN)/perilune-render survey --manifest "$(3)-plan" --out "$(3)" && \
{ test -e "$(4)/map.json" || $(BIN)/perilune-train navigate map --dataset "$(3)" --out "$(4)"; }
endef

navigate: nav-frames ## run all navigation methods over the test descents; writes runs/navigate/<name>-methods
	@if test -z "$(OVER)" -a -f "$(METHODS)/methods.md"; then echo "$(METHODS): finished, left unchanged; OVERWRITE=1 replaces it"; else \
	  $(BIN)/perilune-train navigate methods --dataset "$(DATA)/nav" --out "$(METHODS)" \
	  $(if $(wildcard $(NAVIGATE)),--run "$(RUNS)/navigate/$(NAME)") $(if $(wildcard $(MAP)/map.json),--map "$(MAP)") $(OVER); fi

navigate-map: nav-frames ## map the test scenes from orbit; make navigate then uses runs/navigate/<name>-map
	@$(call surveyed,$(DATA)/nav,test,$(DATA)/survey,$(MAP))

DRAWS ?= 200
SCENARIO ?= nominal
MONTE_CARLO := $(RUNS)/navigate/$(NAME)-monte-carlo-$(SCENARIO)
navigate-monte-carlo: nav-frames ## run the filter over 200 random draws of each test descent (DRAWS=number SCENARIO=nominal|outage|wrong-prior|false-detections)
	@if test -z "$(OVER)" -a -f "$(MONTE_CARLO)/monte_carlo.md"; then echo "$(MONTE_CARLO): finished, left unchanged; OVERWRITE=1 replaces it"; else \
	  $(BIN)/perilune-train navigate monte-carlo --dataset "$(DATA)/nav" --draws $(call quoted,$(DRAWS)) \
	  --scenario $(call quoted,$(SCENARIO)) --out "$(MONTE_CARLO)" $(OVER); fi

closed-loop: setup ## fly a descent in closed loop: guidance, filter, and images from the server; writes runs/closed-loop
	@$(BIN)/python examples/closed_loop.py --out "$(RUNS)/closed-loop"

##@ Explanation and report
explain: ## compute attention masks and correlations of the trained networks
	@test -f "$(STACK)/metrics.json" -a -f "$(DETECT)" || $(MAKE) --no-print-directory OVERWRITE= train-nav
	@$(BIN)/perilune-train explain $(TRAIN) --dataset "$(DATA)" $(OVER)

# The navigator's poses need all frames of a descent, without its craters.
STACK := $(RUNS)/navigate/$(NAME)-stack
explain-causal: detect-frames ## remove single craters from the test scenes, and measure what changes; writes runs/explain/<name>-causal
	@test -f "$(DETECT)" || $(MAKE) --no-print-directory OVERWRITE= train-detect
	@$(BIN)/perilune-render counterfactual --manifest "$(DATA)/detect" --craters-per-scene 12 --out "$(DATA)/causal"
	@$(BIN)/perilune-render counterfactual --manifest "$(DATA)/detect" --craters-per-scene 0 --sun-azimuth-offset-deg 40 --out "$(DATA)/turned"
	@$(if $(wildcard $(STACK)/metrics.json),$(BIN)/perilune-render counterfactual --manifest "$(DATA)/nav" --craters-per-scene 12 --frames-per-trajectory 1000 --out "$(DATA)/causal-nav")
	@$(BIN)/perilune-train causal $(COMMON) --runs $(call quoted,$(RUNS)) --name $(NAME) --dataset "$(DATA)/detect" --counterfactual "$(DATA)/causal" \
	  --turned "$(DATA)/turned" $(if $(wildcard $(STACK)/metrics.json),--nav-dataset "$(DATA)/nav" --nav-counterfactual "$(DATA)/causal-nav") $(OVER)

# The experiment and the benchmark write to separate folders.
REPORT ?= demo
# Changed frames of the test split, if they exist: make explain-causal renders the first and the last.
CHANGED = $(foreach one,counterfactual:causal shallower:shallower turned:turned,$(if $(wildcard $(DATA)/$(lastword $(subst :, ,$(one)))/dataset.json),--$(firstword $(subst :, ,$(one))) "$(DATA)/$(lastword $(subst :, ,$(one)))"))
REPORTED = $(if $(filter demo,$(REPORT)),--name $(NAME) --dataset "$(DATA)" --runs "$(RUNS)" --out "$(RUNS)/report/$(NAME)" $(CHANGED))
report: setup ## write one HTML page on datasets, runs and frames (REPORT=demo|paper|benchmark); writes runs/report/
	@$(BIN)/perilune-train report --kind $(call quoted,$(REPORT)) $(REPORTED)

##@ Benchmarks and the paper's experiment
# A part of the benchmark is rendered into a separate folder.
BENCHMARK := data/benchmark$(if $(SCENES),-$(SCENES)-scenes)
benchmark-frames: setup # render the locked benchmark (KIND=nav for navigation, SCENES=2 for a part of it, ELEVATION=folder of the elevation models)
	@scripts/render-benchmark $(if $(filter nav,$(KIND)),nav,detect) $(BENCHMARK) $(or $(SCENES),0) $(if $(ELEVATION),$(call quoted,$(ELEVATION)))

# $(1): what kind of run RUN must be.
define checked_run
test -f $(call quoted,$(RUN))/config.yaml || { echo "RUN: "$(call quoted,$(RUN))": no config.yaml there, expected the folder of a $(1) run" >&2; exit 2; }
endef

benchmark: setup ## score the installed detector, or a run (RUN=folder), on the locked benchmark (SCENES=2 for a part of it); writes runs/benchmark/
	@$(if $(RUN),$(call checked_run,detect))
	@$(MAKE) --no-print-directory benchmark-frames KIND=detect
	@$(BIN)/perilune-train detect benchmark $(if $(RUN),--run $(call quoted,$(RUN))) --data $(BENCHMARK)

benchmark-nav: setup ## score direct alignment, or a run (RUN=folder); writes runs/benchmark/<name>-navigate
	@$(if $(RUN),$(call checked_run,navigate))
	@$(MAKE) --no-print-directory benchmark-frames KIND=nav
	@$(BIN)/perilune-train navigate benchmark $(if $(RUN),--run $(call quoted,$(RUN))) --data $(BENCHMARK)

benchmark-landing: setup ## score craters and the filter (DETECTOR=folder, MAPS=folder of maps); writes runs/benchmark/<name>-landing
	@$(MAKE) --no-print-directory benchmark-frames KIND=nav
	@$(BIN)/perilune-train navigate benchmark-landing $(if $(DETECTOR),--detector $(call quoted,$(DETECTOR))) \
	  $(if $(MAPS),--maps $(call quoted,$(MAPS))) --data $(BENCHMARK)

# The experiment has its own default: PRESET=paper.
paper: setup ## repeat the paper's experiment; writes tables, figures and verdicts into runs/paper (PART=whole, gpu or full, GROUND=lunar, CALIBRATE=1, ATTITUDE=1, MINUTES=number, DARKNET=yolov3.weights)
	@$(BIN)/python scripts/paper.py --preset $(if $(filter file,$(origin PRESET)),paper,$(PRESET)) $(if $(PART),--part $(PART)) \
	  $(if $(GROUND),--ground $(GROUND)) $(if $(CALIBRATE),--calibrate) $(if $(ATTITUDE),--attitude) \
	  $(if $(MINUTES),--minutes $(MINUTES)) $(if $(DARKNET),--darknet $(call quoted,$(DARKNET)))

bench: ## run one measurement (NAME=labels); without NAME, list all measurements
ifneq ($(origin NAME),command line)
	@awk -F ':[^#]*# ' '/^bench-[a-z-]+:[^#]*# / { printf "  %-22s%s\n", substr($$1, 7), $$2 }' $(MAKEFILE_LIST)
else
	@grep -qF -- bench-$(call quoted,$(NAME)): $(MAKEFILE_LIST) || { echo "NAME: got "$(call quoted,$(NAME))", expected a name that make bench lists" >&2; exit 2; }
	@$(MAKE) --no-print-directory bench-$(call quoted,$(NAME)) NAME=$(call quoted,$(PRESET))
endif

##@ Development
JOBS ?= 2
# A test marked `slow` kills processes, starts Ray or a browser, or renders the shared manifests again.
test: setup-dev ## run the tests in JOBS=2 processes (SLOW=1 also runs the tests marked slow, as .ci/run does)
	@$(BIN)/python -m pytest -n $(JOBS) --dist worksteal --max-worker-restart=0 -m "$(if $(SLOW),not hostile,not slow and not hostile)"

test-hostile: setup-dev ## run hostile and damaged input through every command
	@log=$$(mktemp) && trap 'rm -f "$$log"' EXIT && PERILUNE_HOSTILE_LOG="$$log" OMP_NUM_THREADS=1 \
	  $(BIN)/python -m pytest -n $(JOBS) --dist worksteal --max-worker-restart=0 -m hostile tests/hostile

# Tracing slows every line of every library, on Python before 3.12.
coverage: setup-dev ## run all tests and print their line coverage; takes 1.6 times as long
	@PYTEST_ADDOPTS="--cov --cov-report=term" $(MAKE) --no-print-directory test SLOW=1

lint: setup-dev ## ruff (rules and format) and mypy
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy shared/perilune_shared render/perilune_render train/perilune_train perilune/perilune benchmarks examples

docs: docs-build ## build and serve the documentation (http://127.0.0.1:8000)
	@NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs serve

docs-build: setup-dev # build the documentation into site/; a broken link or name is an error
	@NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

bench-render: setup-dev # time of a frame, compared with a bare Blender loop; writes runs/bench/render.json
	@$(BIN)/python -m benchmarks.dataset.render

bench-kill: setup-dev # renderings disturbed at random moments (SIGKILL, Ctrl-C, full disk, lost nodes and stores), resumed and compared; writes runs/bench/kill.json
	@$(BIN)/python -m benchmarks.kill

bench-scale: setup-dev # frames per second by executor, number of processes and threads; writes runs/bench/scale.json
	@$(BIN)/python -m benchmarks.dataset.scale

bench-requests: setup-dev # number of requests to an S3 store for a frame, trajectory, scene and dataset; writes runs/bench/requests.json
	@$(BIN)/python -m benchmarks.dataset.requests

bench-scaling: setup-dev # core hours and bytes of up to 100 million frames, estimated; writes runs/bench/scaling.json
	@$(BIN)/python -m benchmarks.dataset.scaling

compare-nac: bench-nac

bench-nac: setup # compare rendered frames with real NAC crops (NAC=folder); writes runs/nac/
	@$(BIN)/python -m benchmarks.nac.compare "$(NAC)" $(COMMON) --out "$(RUNS)/nac"

bench-terrain: setup-dev # time and memory of generating terrain on one core; writes runs/bench/terrain.json
	@$(BIN)/python -m benchmarks.scene.terrain

bench-megapixel: setup-dev # memory and time of a descent in 1024 x 1024 pixels, and KLT residuals on changes of level; writes runs/bench/megapixel.json
	@$(BIN)/python -m benchmarks.scene.megapixel

bench-photometry: setup-dev # rendered radiance, compared with the formulas; writes runs/bench/photometry.json
	@$(BIN)/python -m benchmarks.scene.photometry

bench-manifest: setup-dev # time and memory of reading 100,000 frames and 5 million labels; writes runs/bench/manifest.json
	@$(BIN)/python -m benchmarks.dataset.manifest

bench-plan: setup-dev # time and memory of planning 10 million frames; writes runs/bench/plan.json
	@$(BIN)/python -m benchmarks.dataset.plan

bench-memory: setup-dev # resident memory of a process that renders 5000 frames; writes runs/bench/memory.json
	@$(BIN)/python -m benchmarks.dataset.memory

bench-profile: setup-dev # processor time of each step of rendering a frame with the engine heightfield; writes runs/bench/profile_frames.json
	@$(BIN)/python -m benchmarks.dataset.profile_frames

bench-develop: setup-dev # frames developed per second on one core; writes runs/bench/develop.json
	@$(BIN)/python -m benchmarks.dataset.develop

bench-regenerate: setup-dev # number of frames that are identical when rendered again from the manifest; writes runs/bench/regenerate.json
	@$(BIN)/python -m benchmarks.dataset.regenerate

bench-same-bytes: setup-dev # hash of every stage of a frame, to find where two processors differ (COMPARE=file of another machine); writes runs/bench/same_bytes.json
	@$(BIN)/python -m benchmarks.dataset.same_bytes $(if $(COMPARE),--compare $(call quoted,$(COMPARE)))

bench-labels: setup-dev # label ellipses, compared with rendered rings; writes runs/bench/labels.json and docs/pictures/labels_histogram.png
	@$(BIN)/python -m benchmarks.scene.labels --picture docs/pictures/labels_histogram.png

bench-lens-labels: setup-dev # label ellipses under lens models of 180 degrees, compared with projected rims; writes runs/bench/lens_labels.json
	@$(BIN)/python -m benchmarks.scene.lens_labels

bench-truth: setup-dev # depth and normals of EXRs, compared with cast rays; writes runs/bench/truth.json
	@$(BIN)/python -m benchmarks.scene.truth

bench-other-ground: setup-dev # rims and the installed detector over ground of another generator (.venv/bin/pip install terraingenpy); writes runs/bench/other_ground.json
	@$(BIN)/python -m benchmarks.scene.other_ground

bench-engines: setup-dev # speed of both engines, and agreement of their radiance, depth and labels; writes runs/bench/engines.json
	@$(BIN)/python -m benchmarks.scene.engines

bench-gpu: setup-dev # agreement of a CUDA device with the processor, and its frames per second; writes runs/bench/gpu.json
	@scripts/bench_gpu.sh

bench-serve: setup-dev # frames per second of the image server, and its memory over 20,000 frames; writes runs/bench/serve.json
	@$(BIN)/python -m benchmarks.scene.serve

bench-contrast: setup-dev # AUC of contrast for the craters that the detector finds; writes runs/bench/contrast.json
	@$(BIN)/python -m benchmarks.train.contrast "$(DATA)/detect" "$(RUNS)/detect/$(NAME)"

GATES ?= "$(RUNS)/detect/$(NAME)"
bench-gates: detect-frames # AP and variation of attention masks of detect runs on the validation split (GATES="runs/detect/a runs/detect/b"); writes runs/bench/gates.json
	@$(BIN)/python -m benchmarks.train.gates "$(DATA)/detect" $(GATES)

bench-infer: setup-dev # time of the detector per image on two cores, by engine; writes runs/bench/infer.json
	@$(BIN)/python -m benchmarks.train.infer

bench-paper-causes: setup-dev # causes of the failure of short training runs of the paper's detector (ground, loss, gates), about half an hour on two cores; writes runs/paper/paper-causes.json
	@$(BIN)/python -m benchmarks.train.paper_causes

bench-captured: setup-dev # training speed of both detectors on a GPU, with and without CUDA graphs; writes runs/bench/captured.json
	@$(BIN)/python -m benchmarks.train.captured

bench-pose-limits: setup-dev # limits of the pose navigator (steps, descents, views, features), on the runs of the experiment; writes runs/bench/pose-limits.json
	@$(BIN)/python -m benchmarks.train.pose_limits --detector $(RUNS)/paper/detect/yolov3-half-0 --dataset data/paper/headline/nav --hidden 256

bench-shared: setup-dev # speed of training, detection, rendering and the filter beside other work, relative to the fair share; writes runs/bench/shared.json
	@$(BIN)/python -m benchmarks.shared

bench-latency: setup-dev # time of the detector by groups of operations, and the limit of the processor; writes runs/bench/latency.json
	@$(BIN)/python -m benchmarks.train.latency

bench-train: detect-frames # training speed, compared with training from memory and with a bare loop; writes runs/bench/train.json
	@$(BIN)/python -m benchmarks.train.train --dataset "$(DATA)/detect" --preset $(PRESET)

bench-transfer: detect-frames # compare four ways to start from a frozen backbone; writes runs/bench/transfer.json
	@$(BIN)/python -m benchmarks.train.transfer --dataset "$(DATA)/detect"

bench-landing: setup-dev # all methods of navigation on the validation descents of shipped-nav; writes runs/bench/landing
	@test -e data/shipped/nav/dataset.json || $(BIN)/perilune-render dataset --manifest data_manifests/shipped-nav --out data/shipped/nav
	@$(call surveyed,data/shipped/nav,val,data/shipped/survey,runs/bench/landing-map)
	@$(BIN)/perilune-train navigate methods --dataset data/shipped/nav --split val --allow-overlap --map runs/bench/landing-map --out runs/bench/landing

bench-motion: setup-dev # relative motion under noise, blur and a wrong prior, on the validation descents of shipped-nav; writes runs/bench/motion.json
	@test -e data/shipped/nav/dataset.json || $(BIN)/perilune-render dataset --manifest data_manifests/shipped-nav --out data/shipped/nav
	@$(BIN)/python -m benchmarks.train.motion data/shipped/nav

bench-learned-alignment: setup-dev # train learned features in direct alignment on shipped-nav and compare them with alignment, about 20 minutes; writes runs/bench/learned-alignment.json
	@test -e data/shipped/nav/dataset.json || $(BIN)/perilune-render dataset --manifest data_manifests/shipped-nav --out data/shipped/nav
	@$(BIN)/python -m benchmarks.train.learned_alignment --train data/shipped/nav --validate data/shipped/nav

bench-monte-carlo: setup-dev # time of 1200 flights of the navigation filter on two cores, over the validation descents of shipped-nav; writes runs/bench/monte_carlo.json
	@test -e data/shipped/nav/dataset.json || $(BIN)/perilune-render dataset --manifest data_manifests/shipped-nav --out data/shipped/nav
	@OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.train.monte_carlo data/shipped/nav

bench-stream: setup-dev # navigator trained on rendered sequences, compared with training on a dataset alone, at equal processor time; writes runs/bench/stream.json
	@$(BIN)/python -m benchmarks.train.stream

bench-fresh: setup-dev # detector trained on frames rendered during training, compared with stored frames, at equal processor time; writes runs/bench/fresh.json
	@$(BIN)/python -m benchmarks.train.fresh

bench-suspect: setup-dev # pictures that detect predict suspects not to show the Moon, among lunar pictures and others (MOON=folder OTHERS=folder)
	@$(BIN)/python -m benchmarks.train.suspect $(call quoted,$(MOON)) --others $(call quoted,$(OTHERS))

bench-robust: setup-dev # AP of the installed detector on validation frames under JPEG, gamma, stretch, few grey levels, blur and noise, one at a time; writes runs/bench/robust.json
	@test -e data/shipped/detect/dataset.json || { $(BIN)/perilune-render plan --manifest data_manifests/shipped-detect --out data/shipped/plan && $(BIN)/perilune-render dataset --manifest data/shipped/plan --out data/shipped/detect; }
	@$(BIN)/python -m benchmarks.train.robust data/shipped/detect

bench-alarms: setup-dev # candidates for the alarm "unlike the training": AUC and alarms on changed frames, textures and datasets (OBLIQUE=folder OTHER="folders"); writes runs/bench/alarms/
	@test -e data/shipped/detect/dataset.json || { $(BIN)/perilune-render plan --manifest data_manifests/shipped-detect --out data/shipped/plan && $(BIN)/perilune-render dataset --manifest data/shipped/plan --out data/shipped/detect; }
	@$(BIN)/python -m benchmarks.train.alarms data/shipped/detect $(if $(OBLIQUE),--oblique $(call quoted,$(OBLIQUE))) $(foreach folder,$(OTHER),--other $(call quoted,$(folder)))

bench-suppress: setup-dev # time of non-maximum suppression of a batch, compared with OpenCV frame by frame; writes runs/bench/suppress.json
	@$(BIN)/python -m benchmarks.train.suppress

# With RECORD=files, first copy these JSON files of runs or benchmarks into results/.
# An existing environment is left unchanged: a linked one may belong to another checkout.
traces: ## fly the landing filter over the inputs of the reference traces again, after a change of the filter
	@test -x $(BIN)/python || $(MAKE) --no-print-directory setup
	@$(BIN)/python -m scripts.reference_traces tables

# The same settings as in docs/notebook/2026-11-28-landing.md; takes an hour on two cores.
TRACE_DATA := --set dataset.nav.n_frames=40 --set dataset.nav.split_by=scene --set dataset.nav.val_share=0 \
  --set dataset.nav.test_share=1 --set 'dataset.nav.flight.azimuth_deg={low: 0, high: 360}' --set 'dataset.nav.sun.elevation_deg={low: 8, high: 65}'
trace-inputs: setup # render the descents of the reference traces from their seeds; write their inputs and tables again
	@$(BIN)/perilune-render dataset --preset large --kind nav --config configs/highland.yaml --set dataset.name=sensors-a --set dataset.nav.n_scenes=2 \
	  --set dataset.nav.trajectories_per_scene=2 $(TRACE_DATA) --set dataset.render.engine=heightfield \
	  --set 'dataset.nav.instruments.inertial_grades=[cubesat,tactical,navigation]' --set dataset.nav.instruments.star_tracker_rate_hz=1 \
	  --set 'dataset.nav.instruments.star_tracker_outages_s=[{low: 30, high: 45}]' --set dataset.nav.instruments.doppler_rate_hz=5 --out data/reference-highland
	@test -f data/reference-relief.tif || $(BIN)/perilune-render ground --preset large --kind nav --config configs/highland.yaml \
	  --set dataset.name=relief-a --pixel-m 5 --out data/reference-relief.tif
	@$(BIN)/perilune-render dataset --preset large --kind nav --dem data/reference-relief.tif --set dataset.name=dem-a --set dataset.nav.n_scenes=1 \
	  --set dataset.nav.trajectories_per_scene=2 $(TRACE_DATA) --out data/reference-relief
	@$(BIN)/python -m scripts.reference_traces inputs

results: setup ## write the headline figures into docs/results.md, README.md and the reviewer's table (RECORD="runs/bench/labels.json ...")
	@$(if $(RECORD),$(BIN)/python scripts/results.py record $(RECORD))
	@$(BIN)/python scripts/results.py write
	@$(BIN)/python -m scripts.assurance

assurance: setup ## write the table for a mission's reviewer, docs/reference/assurance.md, from the records
	@$(BIN)/python -m scripts.assurance

release: setup-dev ## check, build and tag a version from a clean tree (VERSION=0.1.0); uploads only with UPLOAD=1
	@$(BIN)/python scripts/release.py release $(call quoted,$(or $(VERSION),$(error VERSION: got nothing, expected a version: make release VERSION=0.1.0))) \
	  $(if $(filter 1,$(UPLOAD)),--upload)

clean: ## remove the environment; data and runs stay
	rm -rf $(VENV)
