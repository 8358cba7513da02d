"""Write a COLMAP model with known poses in place of SfM's, its points triangulated anew.

    python pipelines/known_poses.py SPARSE CAMERAS_JSON NEW_MODEL

For calibrated rigs and robot arms: give the result to ``polmvs`` as ``--sparse NEW_MODEL``.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from polmvs.cli.terminal import Terminal, guarded
from polmvs.poses.known_poses import write_known_poses


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sparse", type=Path, help="COLMAP model of the same images")
    parser.add_argument(
        "cameras", type=Path, metavar="CAMERAS_JSON", help="K and cam_from_world of the images"
    )
    parser.add_argument("new", type=Path, metavar="NEW_MODEL", help="folder to write, a new one")
    args = parser.parse_args(argv)

    def run() -> int:
        model = write_known_poses(args.sparse, args.cameras, args.new)
        tracks = model.tracks
        print(
            f"{args.new}: {len(model.views)} views, {len(tracks.point3D_ids)} points, "
            f"mean reprojection error {tracks.errors.mean():.2f} px"
        )
        return 0

    with Terminal(verbose=False) as terminal:
        return guarded(run, terminal, parser.prog)


if __name__ == "__main__":
    raise SystemExit(main())
