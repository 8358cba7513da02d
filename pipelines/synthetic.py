"""Make a capture with printed texture and true cameras, of any number of views.

    python pipelines/synthetic.py CAPTURE --views 282

A black glossy board or dome with printed labels on a printed table, raw mosaics with photon noise
of 8 bits, seen from all around by a sensor of tilted polarizers; names in random order. Beside
them, as for any capture with truth, ``gt/cameras.json``, and with ``--maps`` depth, normals and
masks. Its SfM has a known answer, so that pairs, mappers and growth can be measured.
"""

from __future__ import annotations

from dataclasses import MISSING, dataclass
from pathlib import Path

from polmvs.cli.call import Call, TerminalOptions
from polmvs.cli.running import script
from polmvs.cli.terminal import Terminal
from polmvs.config import OptionGroup, default_num_workers, option
from polmvs.parallel import Workers
from polmvs.synthetic.printed import orbit_views
from polmvs.synthetic.printed_capture import Part, camera_of, scene_of, write_printed_capture


@dataclass(frozen=True, kw_only=True)
class Arguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    capture: Path = option(MISSING, "folder to write, a new one", positional=True)
    part: Part = option(Part.BOARD, "shape of the part")
    views: int = option(100, "how many views", least=2)
    width: int = option(612, "of the half-size images, px; their height is 5/6 of it", least=48)
    ordered: bool = option(False, "names follow the orbit")
    maps: bool = option(False, "write depth, normals and masks as well")
    seed: int = option(0, "of print, places, names and noise", least=0)
    workers: int = option(default_num_workers(), "processes to share the views among", least=1)


def _make(call: Call, terminal: Terminal) -> int:
    given = call.get(Arguments)
    camera = camera_of(given.width)
    with Workers(given.workers) as workers, terminal.stage("views", given.views) as progress:
        write_printed_capture(
            given.capture,
            orbit_views(given.views, camera, seed=given.seed, ordered=given.ordered),
            scene_of(given.part, given.seed),
            maps=given.maps,
            workers=workers,
            on_progress=progress,
        )
    intrinsics = f"{camera.fx:.10g},{camera.fy:.10g},{camera.cx:.10g},{camera.cy:.10g}"
    terminal.show(
        f"{given.capture}: {given.views} views; --intrinsics {intrinsics}",
        {"capture": given.capture, "views": given.views, "intrinsics": intrinsics},
    )
    return 0


main = script(__file__, __doc__, _make, (Arguments, TerminalOptions))

if __name__ == "__main__":
    raise SystemExit(main())
