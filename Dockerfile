# perilune with Blender's module and all Python packages: `make demo` on any Linux. See docs/how-to/docker.md.
FROM debian:12-slim

COPY scripts/system-libraries /tmp/
# hadolint ignore=DL3008
RUN apt-get update -qq \
 && apt-get install -y -qq --no-install-recommends ca-certificates make python3.11 python3.11-venv \
 && /tmp/system-libraries \
 && rm -r /var/lib/apt/lists/* /tmp/system-libraries

# Frames, runs and datasets written into mounted folders belong to the user with this ID.
ARG UID=1000
RUN useradd --create-home --uid "$UID" perilune && install -d -o perilune /perilune /perilune/data /perilune/runs
USER $UID
WORKDIR /perilune
ENV PIP_NO_CACHE_DIR=1

# pip reads this variable; an index of CPU builds of PyTorch makes the image several gigabytes smaller.
ARG PIP_EXTRA_INDEX_URL
# Only what `make setup` reads, so that a change of the code does not install the packages again.
COPY --chown=perilune Makefile constraints.txt requirements-dev.txt pyproject.toml ./
COPY --chown=perilune scripts/system-libraries scripts/
COPY --chown=perilune shared/pyproject.toml shared/README.md shared/LICENSE shared/
COPY --chown=perilune shared/perilune_shared/__init__.py shared/perilune_shared/
COPY --chown=perilune render/pyproject.toml render/README.md render/LICENSE render/
COPY --chown=perilune render/perilune_render/__init__.py render/perilune_render/
COPY --chown=perilune train/pyproject.toml train/README.md train/LICENSE train/
COPY --chown=perilune train/perilune_train/__init__.py train/perilune_train/
COPY --chown=perilune perilune/pyproject.toml perilune/README.md perilune/LICENSE perilune/
COPY --chown=perilune perilune/perilune/__init__.py perilune/perilune/
RUN make setup

COPY --chown=perilune . .
# The copied files may be newer than .ready; without this, make would install again.
RUN touch .venv/.ready

VOLUME ["/perilune/data", "/perilune/runs"]
CMD ["make", "demo"]
