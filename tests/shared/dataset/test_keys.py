"""Every command refuses a dataset with broken keys, with a message of one line."""

import pytest
from tests.helpers.drawn_dataset import seal
from tests.helpers.hostile import rewrite
from typer.testing import CliRunner

from perilune_shared.cli.main import app
from perilune_shared.dataset.keys import check_keys
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.dataset.parts import Part
from perilune_shared.editing.merge import merge
from perilune_shared.editing.pack import pack
from perilune_shared.editing.split import Split, split_dataset
from perilune_shared.editing.subset import subset
from perilune_shared.errors import UserError
from perilune_shared.export.stats import summary
from perilune_shared.labels.selection import read_labels

BROKEN = {
    "a label of no crater": ("labels", lambda rows: rows[3].update(crater_id=12345), "labels: crater_id"),
    "a label of no frame": ("labels", lambda rows: rows[3].update(frame_id="s000/t000/000099"), "labels: frame_id"),
    "a label of another scene": ("labels", lambda rows: rows[3].update(scene_id="s001"), "labels: scene_id"),
    "no craters": ("craters", lambda rows: rows.clear(), "labels: crater_id"),
    "a crater twice": ("craters", lambda rows: rows.append(dict(rows[5])), r"craters: scene_id\+crater_id"),
    "a label twice": ("labels", lambda rows: rows.append(dict(rows[5])), r"labels: frame_id\+crater_id"),
    "a frame twice": ("frames", lambda rows: rows.append(dict(rows[1])), "frames: frame_id"),
    "a scene twice": ("scenes", lambda rows: rows.append(dict(rows[0])), "scenes: scene_id"),
    "a trajectory twice": ("trajectories", lambda rows: rows.append(dict(rows[0])), "trajectories: scene_id"),
    "no trajectory": ("trajectories", lambda rows: rows.pop(), "frames: trajectory_id"),
    "no scene": ("scenes", lambda rows: rows.pop(), "trajectories: scene_id"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_every_command_refuses_broken_keys(name, victim, tmp_path):
    table, change, message = BROKEN[name]
    rewrite(victim, table, change)
    seal(victim)
    dataset = open_dataset(victim)
    for work in (
        lambda: subset(dataset, tmp_path / "o", ["diameter_m > 1"]),
        lambda: split_dataset(dataset, tmp_path / "o", Split(val_share=0.5, test_share=0)),
        lambda: merge([dataset, dataset], tmp_path / "o"),
        lambda: pack(dataset, tmp_path / "o"),
        lambda: read_labels(dataset),
        lambda: summary(dataset),
    ):
        with pytest.raises(UserError, match=f"{message}.*perilune-manifest validate"):
            work()
    assert not (tmp_path / "o").exists()
    for command in (["stats"], ["export", "--format", "coco", "--out", str(tmp_path / "o")], ["card"]):
        with pytest.raises(UserError, match=message):
            CliRunner().invoke(app, [command[0], str(victim), *command[1:]], catch_exceptions=False)


def test_valid_keys_are_accepted(drawn, crowded_packed):
    for root in (drawn, crowded_packed):
        check_keys(open_dataset(root))


@pytest.mark.parametrize("work", [summary, read_labels])
def test_labels_are_checked_while_they_are_read(work, drawn, monkeypatch):
    opened, plain = [], Part.__init__

    def counted(part, store, path, *rest):
        opened.append(path.split("/")[1])
        plain(part, store, path, *rest)

    monkeypatch.setattr(Part, "__init__", counted)
    work(open_dataset(drawn))
    assert opened.count("labels") == 1
