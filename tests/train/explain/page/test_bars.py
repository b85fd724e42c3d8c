import pandas as pd

from perilune_train.explain.page import bars


def test_each_cascade_has_the_names_of_its_own_steps(monkeypatch, tmp_path):
    figures = []
    monkeypatch.setattr(bars, "save_figure", lambda path, figure, **_: figures.append(figure))
    steps = {"top_down": ["stage 2", "all"], "bottom_up": ["stage 1", "all"]}
    rows = [
        {"direction": direction, "step": step, "map": gate, "spearman": 0.5}
        for direction, names in steps.items()
        for step in names
        for gate in ("B_11", "B_21")
    ]
    bars.draw_randomisation(tmp_path / "a.png", pd.DataFrame(rows))
    figures[0].canvas.draw()
    panels = {axis.get_title().partition(":")[0]: axis for axis in figures[0].axes if axis.get_title()}
    for direction, names in steps.items():
        axis = panels[direction.replace("_", " ")]
        assert [label.get_text() for label in axis.get_yticklabels()] == names
