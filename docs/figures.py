"""The drawn figures of the documentation, each made from the package itself.

python docs/pictures.py [NAME ...]     # into docs/images/, with all other pictures

"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")

import cv2
import matplotlib.pyplot as plt
import numpy as np

import polmvs
from polmvs.camera import PinholeCamera
from polmvs.geometry import unit
from polmvs.normals.estimator import smallest_eigenvectors
from polmvs.polarization.angle_models import phase_direction, phase_from_normal, rows_from_phase
from polmvs.polarization.stokes import axial_difference
from polmvs.report.pictures import NOTHING, angle_picture, gray_picture, scalar_picture
from polmvs.scene import View
from polmvs.synthetic.captures import add_noise, look_at, render_view, ring_of_views
from polmvs.synthetic.surfaces import Plane

IMAGES = Path(__file__).parent / "images"
DEMO = Path(polmvs.__file__).parent / "demo_capture"
# Okabe and Ito's colours, which people with any kind of colour blindness tell apart.
BLUE, ORANGE, GREEN, RED, GREY = "#0072b2", "#e69f00", "#009e73", "#d55e00", "#888888"
OF_MODEL = {"opa": RED, "ppa": BLUE, "tilted": GREEN}

plt.rcParams.update(
    {
        "font.size": 10,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "svg.hashsalt": "polmvs",
        "figure.dpi": 110,
    }
)


def geometry(path: Path) -> None:
    """Ray, phase, plane of incidence, row and normal of one pixel, under PPA and under OPA."""
    figure = plt.figure(figsize=(9.2, 4.4))
    for place, model in enumerate(("ppa", "opa")):
        axis = figure.add_subplot(1, 2, place + 1, projection="3d")
        pixel = np.array([0.55, -0.35, 1.0])  # on the image plane z = 1
        ray = unit(pixel)
        point = 2.2 * pixel
        normal = unit(np.array([-0.75, -0.25, -0.6]))
        phase = phase_from_normal(polmvs.AngleModel.PPA, normal, ray)
        d = phase_direction(phase)
        v = ray if model == "ppa" else np.array([0.0, 0.0, 1.0])
        m = rows_from_phase(polmvs.AngleModel(model), phase, ray)
        color = OF_MODEL[model]
        sides = np.array([[-0.8, -0.6, 1], [0.8, -0.6, 1], [0.8, 0.6, 1], [-0.8, 0.6, 1]])
        _face(axis, sides, GREY, 0.15)
        # The plane of incidence that the model believes in: through the point, along v and d.
        corners = [
            point - a * v + b * d for a, b in ((-0.5, -0.8), (1.5, -0.8), (1.5, 0.8), (-0.5, 0.8))
        ]
        _face(axis, np.array(corners), color, 0.25)
        _line(axis, np.zeros(3), point, "black", "ray $v$" if model == "ppa" else "")
        if model == "opa":
            _line(axis, point - 1.5 * v, point, color, "")
        _arrow(axis, pixel, pixel + 0.5 * d, ORANGE, "phase $d$")
        _arrow(axis, point, point + 0.9 * normal, "black", "normal $n$")
        _arrow(axis, point, point + 0.8 * m, color, "row $m$")
        angle = np.degrees(np.arcsin(abs(m @ normal)))
        title = (
            "PPA: the plane contains the normal"
            if model == "ppa"
            else (f"OPA: the normal is {angle:.0f}° off the plane")
        )
        axis.set_title(title, color=color)
        axis.text(*_shown(np.array([0.0, 0.1, -0.1])), "camera")
        axis.text(*_shown(np.array([-0.4, 0.5, 1.0])), "image", color=GREY)
        axis.set(xlim=(-0.6, 1.9), ylim=(0.4, 2.8), zlim=(-0.6, 1.6))
        axis.view_init(elev=24, azim=-42)
        axis.set_box_aspect((2.5, 2.4, 2.2), zoom=1.25)
        axis.set_axis_off()
    _save(figure, path)


def phase_error(path: Path) -> None:
    """Error of the predicted phase over the image of an oblique plane, for each model."""
    view = _oblique_view()
    surface = Plane(np.zeros(3), np.array([0.0, 0.0, 1.0]))
    seen = render_view(view, surface, sensor="tilted")
    rays = view.camera.rays(
        np.stack(
            np.meshgrid(np.arange(view.camera.width) + 0.5, np.arange(view.camera.height) + 0.5),
            axis=-1,
        )
    )
    figure, axes = plt.subplots(1, 4, figsize=(10, 2.5), layout="constrained")
    axes[0].imshow(angle_picture(seen.phase))
    axes[0].set_title("phase measured on a plane", fontsize=10)
    for axis, model in zip(axes[1:], ("opa", "ppa", "tilted"), strict=True):
        measured = seen.phase
        if model == "tilted":  # what the correction for the polarizers' tilt makes of it
            measured = render_view(view, surface, sensor="ppa").phase
        predicted = phase_from_normal(polmvs.AngleModel(model), seen.normals_in_cam, rays)
        error = np.abs(np.degrees(axial_difference(measured, predicted)))
        image = axis.imshow(error, cmap="inferno", vmin=0, vmax=20)
        rms = np.sqrt(np.nanmean(error**2))
        axis.set_title(f"{model.upper()}: error {rms:.1f}° rms", fontsize=10)
    figure.colorbar(image, ax=axes, shrink=0.8, label="degrees")
    for axis in axes:
        axis.set_axis_off()
    _save(figure, path)


def rows(path: Path) -> None:
    """Planes of incidence of ten views of one point, as great circles seen along its normal."""
    camera = PinholeCamera(width=612, height=512, fx=445, fy=445, cx=306, cy=256)
    point, normal = np.array([0.12, 0.05, 0.0]), np.array([0.0, 0.0, 1.0])
    views = ring_of_views(10, camera, distance=0.45, elevation_deg=50, target=(0.0, 0.0, 0.0))
    figure, axes = plt.subplots(1, 2, figsize=(8, 4), layout="constrained")
    for axis, model in zip(axes, ("opa", "ppa"), strict=True):
        stacked = []
        for view in views:
            rotation = view.cam_from_world.rotation
            ray = unit(rotation @ (point - view.center_in_world))
            phase = phase_from_normal(polmvs.AngleModel.PPA, rotation @ normal, ray)
            row = rows_from_phase(polmvs.AngleModel(model), phase, ray) @ rotation
            stacked.append(row)
            first = unit(np.cross(row, [0.3, 0.5, 0.8]))
            turn = np.linspace(-np.pi, np.pi, 1441)[:, None]
            circle = np.cos(turn) * first + np.sin(turn) * np.cross(row, first)
            circle = circle[circle[:, 2] > 0.6]
            order = np.argsort(circle @ np.cross(row, normal))
            tilt = np.degrees(np.arccos(circle[order, 2]))[:, None]
            axis.plot(*(tilt * unit(circle[order, :2])).T, color=OF_MODEL[model], lw=1, alpha=0.8)
        found = np.linalg.svd(np.array(stacked))[2][-1]
        found = found * np.sign(found[2])
        off = np.degrees(np.arccos(min(1.0, found @ normal)))
        axis.plot(0, 0, "k+", ms=14, mew=2, label="true normal")
        axis.plot(
            *(off * unit(found[:2] + 1e-12)),
            "o",
            color=OF_MODEL[model],
            mec="white",
            ms=8,
            label=f"estimate, {off:.1f}° off",
        )
        axis.set(
            xlim=(-25, 25),
            ylim=(-25, 25),
            aspect="equal",
            title=model.upper(),
            xlabel="tilt of the normal, degrees",
        )
        axis.legend(loc="upper right", fontsize=9)
    _save(figure, path)


def dolp(path: Path) -> None:
    """Degree of polarization by the angle between ray and normal."""
    figure, axis = plt.subplots(figsize=(6.4, 3.2), layout="constrained")
    camera = PinholeCamera(width=2, height=2, fx=1e4, fy=1e4, cx=1, cy=1)
    angles = np.arange(0.5, 89.0, 0.5)
    for light, color in (("specular", BLUE), ("diffuse", ORANGE)):
        values = []
        for angle in np.radians(angles):
            center = [np.sin(angle), 0.0, np.cos(angle)]
            view = View(
                name="a.png", camera=camera, cam_from_world=look_at(center, (0, 0, 0), (0, 1, 0))
            )
            surface = Plane(np.zeros(3), np.array([0.0, 0.0, 1.0]))
            values.append(float(np.nanmean(render_view(view, surface, light=light).dolp)))
        axis.plot(angles, values, color=color, lw=2)
        peak = int(np.argmax(values)) if light == "specular" else len(angles) - 12
        axis.annotate(
            {"specular": "mirror-like (black, glossy)", "diffuse": "diffuse (bright, matt)"}[light],
            (angles[peak], values[peak]),
            (angles[peak] - 47, values[peak] - 0.04),
            color=color,
        )
    axis.axvspan(30, 70, color=GREEN, alpha=0.12)
    axis.text(50, 0.03, "take most views here", ha="center", color=GREEN)
    axis.axhline(0.1, color=GREY, ls="--", lw=1)
    axis.text(1, 0.12, "--min-dolp", color=GREY)
    axis.set(
        xlabel="angle between the viewing ray and the surface normal, degrees",
        ylabel="DoLP",
        xlim=(0, 89),
        ylim=(0, 1.02),
    )
    _save(figure, path)


def exposure(path: Path) -> None:
    """Error of the AoLP by brightness and DoLP, simulated with noise, 8 bits and clipping."""
    rng = np.random.default_rng(0)
    levels = np.geomspace(0.01, 2.0, 40)  # s0 in full scales; I of one polarizer is about half
    figure, axis = plt.subplots(figsize=(6.4, 3.2), layout="constrained")
    for degree, color in ((0.1, ORANGE), (0.3, BLUE), (0.6, GREEN)):
        errors = []
        for level in levels:
            aolp = rng.uniform(0, np.pi, 4000)
            angles = np.radians([0, 45, 90, 135])[:, None]
            ideal = 0.5 * level * (1 + degree * np.cos(2 * (angles - aolp)))
            read = np.clip(np.rint(255 * add_noise(ideal, rng=rng)), 0, 255)
            found = 0.5 * np.arctan2(read[1] - read[3], read[0] - read[2])
            errors.append(np.degrees(np.sqrt(np.mean(axial_difference(found, aolp) ** 2))))
        axis.loglog(50 * levels, errors, color=color, lw=2, label=f"DoLP {degree:g}")
    axis.axvspan(98, 100, color=RED, alpha=0.3)
    axis.text(93, 30, "clips", color=RED, ha="right")
    axis.axvspan(25, 70, color=GREEN, alpha=0.12)
    axis.text(42, 0.13, "aim here", color=GREEN, ha="center")
    axis.set(
        xlabel="mean of the four samples, % of full scale (8 bits)",
        ylabel="error of the AoLP,\ndegrees rms",
        xlim=(0.5, 100),
        ylim=(0.1, 60),
    )
    axis.legend(loc="lower left")
    _save(figure, path)


def views(path: Path) -> None:
    """Error of a normal by the number of views, from all around and from a straight rail."""
    rng = np.random.default_rng(0)
    numbers = (2, 3, 4, 5, 6, 8, 10, 12, 16, 20)
    noise = np.radians(1.5)
    figure, axis = plt.subplots(figsize=(6.4, 3.2), layout="constrained")
    cases = {
        "all around": (BLUE, 360.0),
        "a quarter of a circle": (ORANGE, 90.0),
        "a straight rail\nover the normal": (RED, 0.0),
    }
    for name, (color, arc) in cases.items():
        errors = []
        for number in numbers:
            normal = np.array([0.0, 0.0, 1.0])
            samples = []
            for _ in range(300):
                if arc:
                    start = rng.uniform(0, 2 * np.pi)
                    azimuth = start + np.radians(arc) * np.arange(number) / number
                    rays = np.stack(
                        [0.7 * np.cos(azimuth), 0.7 * np.sin(azimuth), np.full(number, -0.714)],
                        axis=-1,
                    )
                else:
                    x = np.linspace(-0.9, 0.95, number)
                    rays = unit(np.stack([x, 0 * x, -np.ones(number)], axis=-1))
                plane = unit(np.cross(rays, normal) + 1e-9)
                # A phase error turns the plane of incidence about its ray.
                turn = noise * rng.standard_normal(number)[:, None]
                rows_ = np.cos(turn) * plane + np.sin(turn) * np.cross(rays, plane)
                a = rows_.T @ rows_
                packed = np.array([a[0, 0], a[1, 1], a[2, 2], a[0, 1], a[0, 2], a[1, 2]])[:, None]
                found = smallest_eigenvectors(packed)[1][:, 0]
                samples.append(np.degrees(np.arccos(min(1.0, abs(found @ normal)))))
            errors.append(np.mean(samples))
        axis.loglog(numbers, errors, "o-", color=color, label=name)
    axis.set(
        xlabel="views of a point", ylabel="error of the normal,\ndegrees (mean)", ylim=(0.2, 90)
    )
    axis.set_xticks([2, 3, 5, 10, 20], ["2", "3", "5", "10", "20"])
    axis.minorticks_off()
    axis.legend(loc="upper right", fontsize=9)
    _save(figure, path)


def positions(path: Path) -> None:
    """Where to stand: from the side and from above."""
    figure, (side, top) = plt.subplots(1, 2, figsize=(8.4, 3.4), layout="constrained")
    side.fill_between([-0.3, 0.3], 0, 0.12, color="#333333")
    side.text(0, 0.2, "part", ha="center")
    side.plot([-1.2, 1.2], [0, 0], color=GREY)
    side.text(-1.18, -0.1, "textured ground: newspaper, printed noise", fontsize=9, color=GREY)
    for azimuth in (-1, 1):
        for elevation in (25, 45, 65):
            a = np.radians(elevation)
            _camera(side, azimuth * np.cos(a), np.sin(a), BLUE)
    _camera(side, 0.0, 1.05, ORANGE)
    side.text(
        0.1,
        1.06,
        "straight above: little polarization,\none view of it is enough",
        fontsize=9,
        color=ORANGE,
    )
    side.text(1.02, 0.3, "20°\nto 65°", fontsize=9, color=BLUE)
    side.set(xlim=(-1.3, 1.6), ylim=(-0.2, 1.3), aspect="equal", title="from the side")
    top.add_patch(plt.Rectangle((-0.3, -0.2), 0.6, 0.4, color="#333333"))
    for ring, (radius, number, shift) in enumerate(((1.0, 8, 0.0), (0.75, 6, 0.4))):
        for azimuth in shift + np.arange(number) * 2 * np.pi / number:
            _camera(top, radius * np.cos(azimuth), radius * np.sin(azimuth), (BLUE, GREEN)[ring])
    top.set(
        xlim=(-1.3, 1.3),
        ylim=(-1.2, 1.2),
        aspect="equal",
        title="from above: all around, two heights",
    )
    for axis in (side, top):
        axis.set_axis_off()
    _save(figure, path)


def exposures(path: Path) -> None:
    """One frame of the bundled capture well, over- and underexposed: what is left of it."""
    raw = cv2.imread(str(DEMO / "raw" / "003.png"), cv2.IMREAD_UNCHANGED).astype(np.float64)
    figure, axes = plt.subplots(3, 3, figsize=(8.6, 6.6), layout="constrained")
    cases = {"as it is": 1.0, "four times the light: clips": 4.0, "a twentieth of it: noise": 0.05}
    for column, (name, factor) in zip(axes.T, cases.items(), strict=True):
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "frame.png"
            cv2.imwrite(str(file), np.clip(np.rint(raw * factor), 0, 255).astype(np.uint8))
            stokes = polmvs.read_stokes(file, full_scale=255.0)
        column[0].imshow(gray_picture(stokes.s0 / 2, 0.5))
        column[0].set_title(name, fontsize=10)
        aolp = np.where(stokes.valid, stokes.aolp, np.nan)
        column[1].imshow(angle_picture(aolp, strength=stokes.dolp / 0.3))
        sigma = np.where(stokes.valid & (stokes.dolp > 0.1), np.degrees(stokes.sigma_aolp), np.nan)
        column[2].imshow(scalar_picture(sigma, 0, 10))
        usable = np.mean(np.isfinite(sigma))
        column[2].set_title(
            f"{100 * usable:.0f} % usable, median {np.nanmedian(sigma):.1f}°", fontsize=9
        )
    for row, label in zip(
        axes, ("intensity", "AoLP where valid", "deviation of the AoLP,\n0 to 10°"), strict=True
    ):
        row[0].set_ylabel(label)
    for axis in axes.flat:
        axis.set(xticks=[], yticks=[], facecolor=(NOTHING / 255,) * 3)
        for spine in axis.spines.values():
            spine.set_visible(False)
    _save(figure, path, dpi=80)


FIGURES: dict[str, Callable[[Path], None]] = {
    "geometry.svg": geometry,
    "phase_error.png": phase_error,
    "rows.svg": rows,
    "dolp.svg": dolp,
    "exposure.svg": exposure,
    "views.svg": views,
    "positions.svg": positions,
    "exposures.png": exposures,
}


def draw(names: list[str], folder: Path = IMAGES) -> None:
    """Draw the figures of these names, or all."""
    for name in names or FIGURES:
        FIGURES[name](folder / name)


def _oblique_view() -> View:
    camera = PinholeCamera(width=306, height=256, fx=222, fy=222, cx=153, cy=128)
    return View(name="a.png", camera=camera, cam_from_world=look_at([0.0, -0.35, 0.4], (0, 0, 0)))


def _shown(points: np.ndarray) -> np.ndarray:
    """Camera frame to the axes of a 3D plot: depth to the back, image y downwards."""
    x, y, z = np.moveaxis(np.asarray(points), -1, 0)
    return np.stack([x, z, -y], axis=-1)


def _face(axis: plt.Axes, corners: np.ndarray, color: str, alpha: float) -> None:
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    axis.add_collection3d(Poly3DCollection([_shown(corners)], color=color, alpha=alpha))


def _line(axis: plt.Axes, start: np.ndarray, end: np.ndarray, color: str, label: str) -> None:
    axis.plot(*_shown(np.array([start, end])).T, color=color, lw=1.2)
    axis.text(*_shown(0.62 * start + 0.38 * end), f"  {label}", color=color)


def _arrow(axis: plt.Axes, start: np.ndarray, end: np.ndarray, color: str, label: str) -> None:
    axis.quiver(*_shown(start), *_shown(end - start), color=color, lw=2, arrow_length_ratio=0.18)
    axis.text(*_shown(end + 0.1 * (end - start)), label, color=color)


def _camera(axis: plt.Axes, x: float, y: float, color: str) -> None:
    inward = -unit(np.array([x, y]))
    across = np.array([-inward[1], inward[0]])
    eye = np.array([x, y])
    corners = np.array(
        [eye, eye + 0.14 * inward + 0.07 * across, eye + 0.14 * inward - 0.07 * across]
    )
    axis.add_patch(plt.Polygon(corners, color=color))


def _save(figure: plt.Figure, path: Path, dpi: int = 110) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    metadata = {"Date": None} if path.suffix == ".svg" else {}
    figure.savefig(path, metadata=metadata, bbox_inches="tight", dpi=dpi)
    plt.close(figure)
