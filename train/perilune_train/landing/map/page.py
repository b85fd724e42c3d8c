"""The page of a map: errors by diameter, and a picture."""

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.export.foreign_text import code_span, for_markdown
from perilune_train.landing.map.files import SceneMap
from perilune_train.records.markdown import number, table

PICTURE = "map.png"


def page_of(dataset: Dataset, maps: list[SceneMap]) -> str:
    """The page as Markdown."""
    lines = ["# Crater map", "", f"Dataset {code_span(dataset.info.name)}, {len(maps)} scenes, two images of each.", ""]
    lines += [
        "Poses of the images are exact. A crater of the map is true if one of the terrain is near: distance in radii,",
        "plus twice the difference of the logarithms of both radii, is below 0.8. Errors are those of true craters.",
        "",
    ]
    for one in maps:
        share = one.catalogue.radius_sigma_share
        stated = f"position {number(one.catalogue.position_sigma_m)} m, diameter {100 * share:.0f} %"
        lines += [f"## {for_markdown(one.scene_id)}: {len(one.catalogue)} craters", "", f"Stated errors: {stated}.", ""]
        head = ["diameter (m)", "mapped", "true", "found", "position RMSE per axis (m)", "height RMSE (m)"]
        rows = [
            [
                str(row["diameter_m"]),
                str(row["mapped"]),
                *(f"{100 * row[key]:.1f} %" for key in ("true_share", "found_share")),
                *(number(row[key]) for key in ("position_rmse_m", "height_rmse_m")),
                f"{100 * row['diameter_bias_share']:+.1f} %, {100 * row['diameter_sigma_share']:.1f} %",
            ]
            for row in one.errors.to_dict("records")
        ]
        lines += [*table([*head, "diameter: mean error, standard deviation"], rows), ""]
    caption = "Middle of the first image: craters found in both images (cyan) and in this one alone (red)"
    return "\n".join([*lines, f"![{caption}]({PICTURE})", "", f"*{caption}.*", ""])
