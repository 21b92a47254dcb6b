"""The figure of closed-loop paths."""

from __future__ import annotations

from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke

from pirl_rl.evaluation.rollouts import RolloutsEvidence
from pirl_rl.figures.evidence import draw
from pirl_rl.figures.planes import broken_at_seams, draw_plane

BEYOND = "0.5"
"""The colour of the part of a panel beyond the plane's box, where V is not drawn."""
ENDS = {"reached": ("o", "limegreen"), "failed": ("X", "red"), "out of time": ("s", "white")}
STARTS = ("white", "orange", "deepskyblue")
OUTLINE = [withStroke(linewidth=1.8, foreground="black")]
"""A dark edge, without which light paths vanish where V is high and dark ones where it is low."""


@draw.register
def draw_rollouts(evidence: RolloutsEvidence) -> dict[str, Figure]:
    """Paths projected onto every plane, with marked starts and ends, over the contours of V at their time to go."""
    sections, paths, values = evidence.sections, evidence.paths, evidence.values
    if paths is None:
        return {}
    figure = Figure(figsize=(max(0.8 + 4.8 * len(sections), 7.0), 5.0), layout="constrained")
    ended = zip(paths.reached.tolist(), paths.failed.tolist(), strict=True)
    ends = ["reached" if reached else "failed" if failed else "out of time" for reached, failed in ended]
    each = len(ends) // len(values)
    all_axes, beyond = figure.subplots(1, len(sections), squeeze=False)[0], False
    for axes, section in zip(all_axes, sections, strict=True):
        mesh = draw_plane(axes, section, section.value)
        axes.set_facecolor(BEYOND)
        projected = section.plane.project(paths.state).numpy()
        beyond = beyond or not bool(section.plane.box.contains(section.plane.project(paths.state)).all())
        for i, end in enumerate(ends):
            path = projected[: paths.steps[i] + 1, i]
            axes.plot(
                *broken_at_seams(path, section.plane.box).T, color=STARTS[i // each], lw=0.8, path_effects=OUTLINE
            )
            axes.plot(*path[0], "D", color=STARTS[i // each], mec="black", mew=0.6, ms=6, zorder=3)
            axes.plot(*path[-1], ENDS[end][0], color=ENDS[end][1], mec="black", mew=0.6, ms=6, zorder=3)
        axes.autoscale()
    if paths.state.shape[-1] > 2:
        note = "Coordinates that a plane does not show change along a path; V is that on the plane."
        figure.suptitle(note, fontsize="small")
    figure.colorbar(mesh, ax=list(all_axes), label=f"V, τ = {sections[0].time:g} s")
    starts = zip(STARTS, values, strict=True)
    handles: list[Artist] = [
        Line2D([], [], color=c, marker="D", mec="black", label=f"from V = {value:.2f}") for c, value in starts
    ]
    handles += [
        Line2D([], [], ls="", marker=marker, color=color, mec="black", label=f"{end}: {ends.count(end)}")
        for end, (marker, color) in ENDS.items()
    ]
    if beyond:
        handles.append(Patch(color=BEYOND, label="beyond the plane"))
    figure.legend(
        handles=handles,
        loc="outside lower center",
        ncols=min(len(handles), 4 * len(sections)),
        fontsize="small",
        facecolor="0.7",
    )
    return {"rollouts": figure}
