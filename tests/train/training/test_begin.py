"""Resume, keep, replace or refuse a run that exists already."""

import pytest

from perilune_shared.config.resolve import Section
from perilune_shared.errors import UserError
from perilune_train.records.metrics_file import write_metrics
from perilune_train.training import begin as begin_module
from perilune_train.training.begin import check_settings, hashes_of, start_run, state_of
from perilune_train.training.runs import RunFolder


class Part(Section):
    size: int
    limits: tuple[float, float] = (1e-5, 2.0)


class Settings(Section):
    rate: float = 0.1


class Larger(Settings):
    workers: int = 0
    part: Part = Part(size=3)


def begin(root, config, overwrite=False, name="a", dataset="1"):
    """A command's first steps: what to do, and the folder prepared."""
    run, inputs = RunFolder(root / "detect" / name), {"dataset": dataset}
    state = state_of(run, "detect", config, inputs, overwrite)
    start_run(run, "detect", config, inputs, state)
    return run, state


def test_only_a_run_of_the_same_task_is_replaced_and_only_when_asked(tmp_path):
    run, state = begin(tmp_path, Settings())
    assert state == "new" and run.root == tmp_path / "detect" / "a"
    assert run.config.read_text() == "detect:\n  rate: 0.1\n"
    write_metrics(run.root, {"test/x": 1.0})
    assert begin(tmp_path, Settings())[1] == "finished" and run.finished
    assert begin(tmp_path, Settings(rate=0.2), overwrite=True)[1] == "new" and not run.finished
    mine = tmp_path / "detect" / "mine"
    mine.mkdir()
    for name, content in (("notes.txt", "keep"), ("config.yaml", "navigate: {}\n")):
        (mine / name).write_text(content)
        with pytest.raises(UserError, match=r"--name: got .* expected another name"):
            begin(tmp_path, Settings(), overwrite=True, name="mine")
    assert len(list(mine.iterdir())) == 2


def test_the_same_command_resumes_and_needs_the_same_settings_and_dataset(tmp_path):
    run, _ = begin(tmp_path, Settings())
    # Stopped before the first state was kept: from the beginning.
    assert begin(tmp_path, Settings())[1] == "new"
    (run.root / "checkpoints").mkdir()
    run.last.write_text("state")
    assert begin(tmp_path, Settings())[1] == "resume" and run.last.exists()
    with pytest.raises(UserError, match=r"config.yaml: detect.rate: got 0.2, expected 0.1, as in the existing run"):
        begin(tmp_path, Settings(rate=0.2))
    with pytest.raises(UserError, match=r"inputs.json: dataset: got SHA-256 2, expected 1, as in the existing run"):
        begin(tmp_path, Settings(), dataset="2")
    with pytest.raises(UserError, match=r"inputs.json: dataset: got nothing, expected 1, as in the existing run"):
        begin(tmp_path, Settings(), dataset=None)
    run.inputs.write_text('{"dataset": null}')
    with pytest.raises(UserError, match=r"dataset: got SHA-256 1, expected nothing, as in the existing run"):
        begin(tmp_path, Settings())
    assert run.last.exists() and run.config.read_text() == "detect:\n  rate: 0.1\n"
    for text in ("[", "[]"):
        run.inputs.write_text(text)
        with pytest.raises(UserError, match=r"inputs.json: content: got no JSON object"):
            begin(tmp_path, Settings())


def test_a_dataset_is_known_by_its_dataset_json(dataset_detect, tmp_path):
    hashes = hashes_of({"dataset": dataset_detect, "file": dataset_detect / "dataset.json", "absent": tmp_path / "x"})
    assert hashes["dataset"] == hashes["file"] and len(hashes["file"]) == 64 and hashes["absent"] is None


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (Larger(), None),
        (Larger(workers=3), None),
        (Larger(part=Part(size=4)), r"detect.part: got {'size': 4.* expected nothing"),
    ],
)
def test_a_run_older_than_a_setting_has_its_default(tmp_path, config, message):
    run, _ = begin(tmp_path, Settings())
    if message is None:
        return check_settings(run, "detect", config)
    with pytest.raises(UserError, match=message):
        check_settings(run, "detect", config)


def test_the_first_other_setting_is_named(tmp_path):
    run, _ = begin(tmp_path, Larger(part=Part(size=5)))
    check_settings(run, "detect", Larger(workers=2, part=Part(size=5)))
    with pytest.raises(UserError, match=r"detect.part.size: got 3, expected 5"):
        check_settings(run, "detect", Larger(rate=0.1))
    with pytest.raises(UserError, match=r"detect.part: got no such setting, expected"):
        check_settings(run, "detect", Settings())
    run.config.write_text("detect:\n  part: {limits: [1.0e-05, 2]}\n")
    with pytest.raises(UserError, match=r"detect.part.size: got 3, expected nothing"):
        check_settings(run, "detect", Larger())
    check_settings(RunFolder(tmp_path / "absent"), "detect", Larger())


def test_only_the_first_process_touches_the_folder(tmp_path, monkeypatch):
    older, _ = begin(tmp_path, Settings())
    monkeypatch.setattr(begin_module, "is_first_process", lambda: False)
    begin(tmp_path, Settings(rate=0.2), overwrite=True)
    assert older.config.read_text() == "detect:\n  rate: 0.1\n"
    # The first one makes it at this very moment: an unfinished file, no config.yaml yet.
    (tmp_path / "detect" / "b").mkdir()
    (tmp_path / "detect" / "b" / ".config.1.part.yaml").touch()
    for overwrite in (False, True):
        begin(tmp_path, Settings(), overwrite, "b")
        begin(tmp_path, Settings(), overwrite, "c")
    assert [path.name for path in (tmp_path / "detect" / "b").iterdir()] == [".config.1.part.yaml"]
    assert not (tmp_path / "detect" / "c").exists()
