"""``polmvs doctor``: a description of this machine, and tests of the parts of polmvs on it."""

from __future__ import annotations

import os
import platform
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from polmvs._version import __version__
from polmvs.cli.call import Call
from polmvs.cli.terminal import Terminal
from polmvs.config import default_num_workers
from polmvs.errors import PolmvsError
from polmvs.io.open3d_import import import_open3d

# Distributions by their modules.
PACKAGES = {
    "numpy": "numpy",
    "scipy": "scipy",
    "cv2": "opencv-python-headless",
    "pycolmap": "pycolmap",
    "open3d": "open3d",
    "matplotlib": "matplotlib",
    "msgspec": "msgspec",
    "cyclopts": "cyclopts",
    "rich": "rich",
}
MAX_NORMAL_ERROR_DEG = 0.1  # of a plane without noise: interpolating its mosaic costs a hundredth


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One line of the report.

    Attributes
    ----------
    what : subject of the check.
    text : its result.
    works : whether polmvs can use it.
    """

    what: str
    text: str
    works: bool = True


def doctor(call: Call, terminal: Terminal) -> int:
    """Run ``polmvs doctor``; the exit status is 1 if a check fails."""
    findings = [*machine(), *(package(*names) for names in PACKAGES.items())]
    checks: dict[str, Callable[[Path], str]] = {
        "plane of a mosaic": _check_plane,
        "COLMAP model": _check_colmap,
        "cloud and mesh": _check_cloud,
        "worker processes": _check_workers,
    }
    with tempfile.TemporaryDirectory(prefix="polmvs-doctor-") as folder:
        for what, check in checks.items():
            start = time.perf_counter()
            with terminal.stage(what, None):
                finding = _tried(f"self-test: {what}", lambda: check(Path(folder)))  # noqa: B023
            seconds = time.perf_counter() - start
            findings.append(replace(finding, text=f"{finding.text}, {seconds:.1f} s"))
    works = all(finding.works for finding in findings)
    width = max(len(finding.what) for finding in findings)
    lines = [
        f"{'  ' if finding.works else '! '}{finding.what:<{width}}  {finding.text}"
        for finding in findings
    ]
    last = "all works" if works else "what is marked ! does not work"
    terminal.show([*lines, last], {"works": works, "findings": findings})
    return 0 if works else 1


def machine() -> list[Finding]:
    """The machine and its Python."""
    free_gb = shutil.disk_usage(Path.cwd()).free / 1e9
    return [
        Finding(what="polmvs", text=f"{__version__} in {Path(__file__).parents[1]}"),
        Finding(what="python", text=f"{platform.python_version()}, {sys.executable}"),
        Finding(what="system", text=platform.platform()),
        Finding(what="cores", text=f"{os.cpu_count()}, of which {default_num_workers()} are used"),
        Finding(what="memory", text=_memory()),
        Finding(what="disk", text=f"{free_gb:.1f} GB free in {Path.cwd()}"),
    ]


def package(module: str, name: str) -> Finding:
    """Version and wheel of a package, and whether it can be imported."""
    try:
        found = distribution(name)
    except PackageNotFoundError:
        return Finding(what=name, text=f"is missing; pip install {name}", works=False)
    lines = (found.read_text("WHEEL") or "").splitlines()
    tags = [line.partition(": ")[2] for line in lines if line.startswith("Tag: ")]
    where = f"wheel {tags[0]}" if tags else "no wheel"
    load = import_open3d if module == "open3d" else lambda: import_module(module)
    return _tried(name, lambda: f"{found.version}, {where}", before=load)


def _tried(
    what: str, work: Callable[[], str], before: Callable[[], object] = lambda: None
) -> Finding:
    """Result of a check; any error is its finding."""
    try:
        before()
        return Finding(what=what, text=work())
    except Exception as error:
        kind = "" if isinstance(error, PolmvsError) else f"{type(error).__name__}: "
        reason = " ".join(f"{kind}{error}".split())
        return Finding(what=what, text=f"fails ({reason})", works=False)


def _memory() -> str:
    """Memory of the machine, from the system's table if there is one."""
    try:
        text = Path("/proc/meminfo").read_text(encoding="ascii")
    except OSError:
        return "not known"
    sizes = dict(line.split(":", 1) for line in text.splitlines() if ":" in line)
    total, free = (float(sizes[key].split()[0]) / 1e6 for key in ("MemTotal", "MemAvailable"))
    return f"{total:.1f} GB, {free:.1f} GB available"


def _check_plane(folder: Path) -> str:
    """Render a mosaic of a plane behind ideal polarizers and measure its normal."""
    import numpy as np

    from polmvs.camera import PinholeCamera
    from polmvs.config import PlaneOptions
    from polmvs.io.images import write_png
    from polmvs.normals.single_view.measurement import measure_planes
    from polmvs.scene import View
    from polmvs.synthetic.captures import look_at, quantize, render_mosaic, render_view
    from polmvs.synthetic.surfaces import Plane

    camera = PinholeCamera(width=160, height=120, fx=110, fy=110, cx=80, cy=60)
    pose = look_at([0.1, 0.5, 0.5], [0.0, 0.1, 0.0])
    view = View(name="plane.png", camera=camera, cam_from_world=pose)
    surface = Plane(np.zeros(3), np.array([0.1, 0.0, 1.0]))
    write_png(folder / view.name, quantize(render_mosaic(view, surface), 16))
    options = PlaneOptions(intrinsics=(camera.fx, camera.fy, camera.cx, camera.cy))
    found = np.array(measure_planes(folder / view.name, options).plane.normal)
    true = render_view(view, surface).normals_in_cam[60, 80]
    error_deg = float(np.degrees(np.arccos(min(1.0, abs(float(found @ true))))))
    if not error_deg < MAX_NORMAL_ERROR_DEG:
        raise ValueError(f"the normal is {error_deg:.2f} deg off")
    return f"normal within {MAX_NORMAL_ERROR_DEG} deg"


def _check_colmap(folder: Path) -> str:
    """Write a COLMAP model and read it again."""
    import numpy as np

    from polmvs.camera import PinholeCamera
    from polmvs.colmap.models import read_model, write_model
    from polmvs.scene import SparseModel, Tracks
    from polmvs.synthetic.captures import ring_of_views

    camera = PinholeCamera(width=160, height=120, fx=110, fy=110, cx=80, cy=60)
    views = tuple(ring_of_views(4, camera))
    tracks = Tracks(
        point3D_ids=np.array([1]),
        points_in_world=np.zeros((1, 3)),
        colors=np.zeros((1, 3), np.uint8),
        errors=np.zeros(1),
        obs_track=np.zeros(2, np.int64),
        obs_view=np.arange(2),
        obs_xy=np.full((2, 2), [80.0, 60.0]),
    )
    write_model(SparseModel(views=views, tracks=tracks, unregistered=()), folder / "sparse")
    model = read_model(folder / "sparse")
    if [view.name for view in model.views] != [view.name for view in views]:
        raise ValueError("the views are not the same")
    return f"{len(model.views)} views written and read"


def _check_cloud(folder: Path) -> str:
    """Write a cloud, read it again and make a mesh of it."""
    import numpy as np

    from polmvs.io.clouds import Cloud, read_cloud, write_cloud
    from polmvs.surface.poisson import poisson_mesh

    rng = np.random.default_rng(0)
    normals = rng.normal(size=(4000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    path = folder / "cloud.ply"
    write_cloud(path, Cloud(points=0.1 * normals, normals=normals))
    mesh = poisson_mesh(read_cloud(path), source=path)
    if not len(mesh.triangles):
        raise ValueError("the mesh is empty")
    return f"{len(mesh.triangles):,} triangles of a sphere"


def _check_workers(folder: Path) -> str:
    """Start two processes."""
    from polmvs.parallel import Workers

    with Workers(2) as workers:
        ids = set(workers.map(_process_id, range(8)))
    return f"{len(ids)} started"


def _process_id(_: int) -> int:
    return os.getpid()
