"""Write a COLMAP model with known poses in place of SfM's, its points triangulated anew.

    python pipelines/known_poses.py SPARSE CAMERAS_JSON NEW_MODEL

For calibrated rigs and robot arms: give the result to ``polmvs`` as ``--sparse NEW_MODEL``.
"""

from __future__ import annotations

from dataclasses import MISSING, dataclass
from pathlib import Path

from polmvs.cli.call import Call, TerminalOptions
from polmvs.cli.running import script
from polmvs.cli.terminal import Terminal
from polmvs.config import OptionGroup, option
from polmvs.poses.known_poses import write_known_poses


@dataclass(frozen=True, kw_only=True)
class Arguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    sparse: Path = option(MISSING, "COLMAP model of the same images", positional=True)
    cameras: Path = option(
        MISSING, "K and cam_from_world of the images", positional=True, metavar="CAMERAS_JSON"
    )
    new: Path = option(MISSING, "folder to write, a new one", positional=True, metavar="NEW_MODEL")


def _known_poses(call: Call, terminal: Terminal) -> int:
    given = call.get(Arguments)
    model = write_known_poses(given.sparse, given.cameras, given.new)
    num_views, num_points = len(model.views), len(model.tracks.point3D_ids)
    error_px = float(model.tracks.errors.mean())
    terminal.show(
        f"{given.new}: {num_views} views, {num_points} points, mean reprojection error "
        f"{error_px:.2f} px",
        {"num_views": num_views, "num_points": num_points, "mean_error_px": error_px},
    )
    return 0


main = script(__file__, __doc__, _known_poses, (Arguments, TerminalOptions))

if __name__ == "__main__":
    raise SystemExit(main())
