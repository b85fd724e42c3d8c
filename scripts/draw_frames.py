"""Draw docs/pictures/frames.png: the five frames of reference of docs/reference/frames.md."""

from pathlib import Path

from perilune_shared.console.interrupts import end_at_interrupt

if __name__ == "__main__":
    # An import by another module must not change how Ctrl-C works.
    end_at_interrupt()

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from perilune_shared.console.command_line import one_command, run_command_line
from perilune_shared.geometry.nominal_trajectory import NominalTrajectory


def axes(ax, origin, vectors, names, colour, length):
    """Draw three labelled arrows."""
    for vector, name in zip(vectors, names, strict=True):
        ax.quiver(*origin, *(length * np.asarray(vector)), color=colour, arrow_length_ratio=0.15, linewidth=1.8)
        ax.text(
            *(np.asarray(origin) + 1.25 * length * np.asarray(vector)), name, color=colour, fontsize=10, ha="center"
        )


def main() -> None:
    """Write docs/pictures/frames.png."""
    figure = plt.figure(figsize=(10, 8))
    ax = figure.add_subplot(projection="3d", computed_zorder=False)
    descent = NominalTrajectory.parabola(1500, 200, 1100, 300.0, 65.0)
    path = descent.position_at(np.linspace(0, 65, 100))
    x, y = np.meshgrid([-1000, 1400], [-1000, 1000])
    ax.plot_surface(x, y, np.zeros_like(x), color="0.8", alpha=0.35)
    ax.plot(*path.T, color="0.4", linestyle="--", linewidth=1)
    site = np.eye(3)
    axes(ax, (0, 0, 0), site, ("$X_L$ west", "$Y_L$ south", "$Z_L$ up"), "tab:blue", 600)
    axes(ax, path[0], site, ("$X_W$", "$Y_W$", "$Z_W$"), "tab:green", 380)
    body = descent.position_at(30.0)
    axes(ax, body, site, ("$X_B$, $x_C$", "$Y_B$", "$Z_B$"), "tab:orange", 380)
    axes(ax, body, np.diag([0.8, -0.8, -0.8]), ("", "$y_C$", "$z_C$ view"), "tab:red", 480)
    style = {"fontsize": 11, "ha": "center"}
    ax.text(*(path[0] - np.array([0, 0, 170])), "$O_W$: first position,\n1500 m up", color="tab:green", **style)
    ax.text(*(body - np.array([420, 0, 60])), "$O_B$ and $O_C$:\nthe lander", color="tab:orange", **style)
    ax.text(
        0,
        -700,
        -60,
        "$O_L$: landing point at a latitude and longitude of $O_S$",
        fontsize=11,
        color="tab:blue",
        ha="center",
    )
    ax.set_box_aspect((1.2, 1, 0.95), zoom=1.45)
    ax.set_xlim(-1000, 1400)
    ax.set_ylim(-1000, 1000)
    ax.set_zlim(0, 1900)
    ax.view_init(elev=16, azim=-68)
    ax.set_axis_off()
    figure.savefig(Path(__file__).parent.parent / "docs/pictures/frames.png", dpi=80, bbox_inches="tight")


if __name__ == "__main__":
    run_command_line(one_command(main))
