"""Tables of results for one network, computed by an explain run and read by its page."""

from dataclasses import dataclass, field

import pandas as pd

TABLES = ("values", "summary", "differences", "tested", "gates", "removal", "randomisation", "stability")
"""Fields of `Evidence` that are tables; each table is written as <name>.parquet."""


@dataclass(frozen=True)
class Evidence:
    """Tables of one network. `with_task` adds the column `task` where it is missing."""

    values: pd.DataFrame
    """Values of each image: kind, map, measure, frame_id, scene_id, value."""
    summary: pd.DataFrame
    """Means and intervals of the values (`significance.summary`)."""
    differences: pd.DataFrame
    """Comparison of each gate with each null (`significance.null_differences`)."""
    tested: pd.DataFrame
    """Comparison of each gate with all nulls together (`significance.against_nulls`)."""
    gates: pd.DataFrame
    """Performance with gates forced to their means: scope, frame_id, scene_id, before, after."""
    removal: pd.DataFrame
    """Performance with pixels removed: map, which, how, frame_id, scene_id, before, after."""
    randomisation: pd.DataFrame
    """Similarity of masks under randomised weights: direction, step, map, spearman, ssim."""
    stability: pd.DataFrame
    """Similarity of masks under changed images: map, change, frame_index, pearson."""
    signs: dict[str, int] = field(default_factory=dict)
    """Sign of each map's craterness on validation images."""
    strongest: str = ""
    """The gate up to stride 8 with the strongest craterness (navigator: largest PCC4) on validation images."""

    def with_task(self, task: str) -> dict[str, pd.DataFrame]:
        """All tables by name, with the column `task` first."""
        tables = {name: getattr(self, name) for name in TABLES}
        return {
            name: table if "task" in table else pd.DataFrame({"task": task, **table}) for name, table in tables.items()
        }
