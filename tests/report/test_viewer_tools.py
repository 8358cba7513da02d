"""Measuring, cropping and choosing cameras in the 3D view, on a scene of known size."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from polmvs.camera import PinholeCamera
from polmvs.config import CropOptions
from polmvs.geometry import RigidTransform
from polmvs.poses.crop_box import CropBox
from polmvs.report import pictures
from polmvs.report.layers import KIND, BoxFrame, Layer, PointColoring, pack_scene
from polmvs.report.page import Page, PagePicture, ViewPage, page_text
from polmvs.scene import PointKind
from polmvs.synthetic.captures import ring_of_views

CAMERA = PinholeCamera(width=60, height=40, fx=50, fy=50, cx=30, cy=20)
SIDE_X, SIDE_Y, HEIGHT = 0.4, 0.3, 0.02  # of a plate, m
FIELD_DEG = 40.0  # of the 3D view, as viewer.js has it
# Turned by 90 degrees about z, and moved.
MARKER = RigidTransform(np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]), np.array([0.1, 0.2, -0.05]))


def plate() -> np.ndarray:
    ticks = [np.linspace(-0.5, 0.5, 81) * side for side in (SIDE_X, SIDE_Y)]
    x, y = np.meshgrid(*ticks)
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, HEIGHT)])


def page_of() -> tuple[str, dict]:
    points = plate()
    beside = np.array([[1.0, 1.0, 0.0], [-1.0, -1.0, 0.0]])
    kind = np.r_[np.full(len(points), PointKind.SURFACE), np.full(2, PointKind.SPARSE)]
    cloud = Layer(
        label="PPA cloud",
        points=np.concatenate([points, beside]),
        normals=np.tile([0.0, 0, 1], (len(points) + 2, 1)),
        values={"intensity": np.full(len(points) + 2, 0.5), "kind": kind},
    )
    corners = points[[0, 80, -81, -1]]
    mesh = Layer(
        label="PPA mesh",
        points=corners,
        normals=np.tile([0.0, 0, 1], (4, 1)),
        values={"intensity": np.full(4, 0.5)},
        triangles=np.array([[0, 1, 2], [2, 1, 3]]),
    )
    views = ring_of_views(4, CAMERA, distance=1.2, elevation_deg=50)
    scene = pack_scene(
        [cloud, mesh],
        {"intensity": PointColoring(label="intensity"), "kind": KIND},
        views,
        (0, None),
        unit=("mm", 1e3),
        frames=[BoxFrame("marker 3", "--box-marker=3", MARKER)],
    )
    grey = pictures.data_uri(np.full((40, 60, 3), 90, np.uint8))
    shown = [
        PagePicture(title=t, alt=t, uri=grey) for t in ("intensity", "AoLP", "reprojected mesh")
    ]
    pages = [ViewPage(name=view.name, pictures=tuple(shown), wipe=None) for view in views]
    page = Page(
        title="plate", sentence="A plate.", facts=[], warnings=(), tables=(), trust=None,
        deviation=None, views=pages, plots=[], scene=scene, thinned=0, stages=[], record={},
    )  # fmt: skip
    return page_text(page), scene.description


class Plate:
    """The page, and where on it a point of the world is seen."""

    def __init__(self, browser, path: Path, description: dict) -> None:
        self.page = browser.new_page(viewport={"width": 900, "height": 900})
        self.complaints: list[str] = []
        self.page.on("console", lambda m: self.complaints.append(m.text))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.goto(path.as_uri())
        self.page.wait_for_selector("#view3d[data-ready=true]", timeout=120_000)
        self.scene = description
        self.canvas = self.page.locator("[data-pane=left] canvas")

    def place(self, point: np.ndarray) -> tuple[float, float]:
        """Px of the page at which the view, as it begins, shows a point."""
        self.canvas.scroll_into_view_if_needed()
        self.page.wait_for_timeout(50)
        box = self.canvas.bounding_box()
        eye, target = np.array(self.scene["eye"]), np.array(self.scene["target"])
        forward = (target - eye) / np.linalg.norm(target - eye)
        right = np.cross(forward, self.scene["up"])
        right /= np.linalg.norm(right)
        seen = np.array([right, np.cross(right, forward), forward]) @ (point - eye)
        half = np.tan(np.radians(FIELD_DEG / 2))
        scale = 0.5 * min(box["width"], box["height"]) / half
        x, y = scale * seen[:2] / seen[2]
        return box["x"] + box["width"] / 2 + x, box["y"] + box["height"] / 2 - y

    def click(self, *points) -> None:
        for point in points:
            self.page.mouse.click(*self.place(np.asarray(point)))

    def said(self, panel: str) -> str:
        return self.page.locator(f"[data-panel={panel}] output").inner_text()

    def option(self) -> list[str]:
        return self.page.input_value("[data-control=option]").split()

    def box(self) -> np.ndarray:
        """Corners (2, 3) of the option's text."""
        text = self.option()[0].removeprefix("--box=")
        return np.array([float(value) for value in text.split(",")]).reshape(2, 3)


@pytest.fixture
def opened(browser, tmp_path: Path) -> Iterator[Plate]:
    text, description = page_of()
    (tmp_path / "page.html").write_text(text)
    plate = Plate(browser, tmp_path / "page.html", description)
    yield plate
    assert plate.complaints == []
    plate.page.close()


def corner(x: float, y: float) -> np.ndarray:
    return np.array([x * SIDE_X / 2, y * SIDE_Y / 2, HEIGHT])


@pytest.mark.parametrize("layer", ["PPA cloud", "PPA mesh"])
def test_the_distance_of_two_points(opened: Plate, layer: str) -> None:
    page = opened.page
    page.select_option("[data-pane=left] select", label=layer)
    page.wait_for_selector(f"[data-pane=left][data-layer='{layer}']")
    page.click("[data-tool=measure]")
    assert "Click two points" in opened.said("measure")
    opened.click(corner(-0.98, -0.98))
    assert opened.said("measure") == "Now the second point."
    opened.click(corner(0.98, 0.98))
    text = opened.said("measure")
    assert text.startswith("Distance ")
    found = float(text.split()[1])
    # Points lie 5 mm apart, and the pointer takes one that is near.
    assert found == pytest.approx(0.98 * 1e3 * np.hypot(SIDE_X, SIDE_Y), abs=15)
    assert text.split()[2] == "mm;"
    page.click("[data-control=nopoints]")
    assert "Click two points" in opened.said("measure")
    opened.click(corner(1.6, 1.6))
    assert "no surface" in opened.said("measure")


def test_two_corners_make_a_box_and_its_option(opened: Plate) -> None:
    page = opened.page
    page.click("[data-tool=box]")
    before = opened.canvas.screenshot()
    opened.click(corner(-0.98, -0.98), corner(0, 0))
    box = opened.box()
    np.testing.assert_allclose(box[:, :2], [[-0.2, -0.15], [0, 0]], atol=0.012)
    assert (box[:, 2] < [HEIGHT, 9]).all()
    assert box[1, 2] > HEIGHT
    assert "mm by" in opened.said("box")
    page.wait_for_timeout(200)
    assert opened.canvas.screenshot() != before
    # What the command line makes of the text.
    options = CropOptions(box=tuple(box.ravel()))
    kept = CropBox(RigidTransform(np.eye(3), np.zeros(3)), box[0], box[1]).contains(plate())
    assert options.box is not None
    assert 0.2 < kept.mean() < 0.3
    page.fill("[data-edge='x to']", "0.5")
    assert opened.box()[1, 0] == 0.5
    page.click("[data-control=nobox]")
    assert opened.option() == []


def test_a_dragged_rectangle_holds_the_part_alone(opened: Plate) -> None:
    page = opened.page
    page.click("[data-tool=box]")
    ends = np.array([opened.place(corner(x, y)) for x in (-1, 1) for y in (-1, 1)])
    low, high = ends.min(axis=0) - 15, ends.max(axis=0) + 15
    page.mouse.move(*low)
    page.mouse.down()
    page.mouse.move(*(0.5 * (low + high)))
    assert page.locator("[data-pane=left] .band").is_visible()
    page.mouse.move(*high)
    page.mouse.up()
    assert not page.locator("[data-pane=left] .band").is_visible()
    box = opened.box()
    assert (box[0] < plate().min(axis=0)).all()
    assert (box[1] > plate().max(axis=0)).all()
    assert (np.diff(box, axis=0)[0] < [SIDE_X + 0.03, SIDE_Y + 0.03, 0.03]).all()
    # The same box in the frame of a marker.
    page.select_option("[data-control=frame]", label="marker 3")
    assert opened.option()[1] == "--box-marker=3"
    local = opened.box()
    inside = CropBox(MARKER, local[0], local[1]).contains(plate())
    assert inside.all()
    np.testing.assert_allclose(np.diff(local, axis=0)[0], [SIDE_Y, SIDE_X, 0], atol=0.03)


def test_the_option_is_copied(opened: Plate) -> None:
    opened.page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    opened.page.click("[data-tool=box]")
    opened.click(corner(-0.9, -0.9), corner(0.9, 0.9))
    opened.page.click("[data-control=copy]")
    copied = opened.page.evaluate("navigator.clipboard.readText()")
    assert copied == " ".join(opened.option())
    assert copied.startswith("--box=-0.")


def test_keys_take_the_middle_and_escape_clears(opened: Plate) -> None:
    page = opened.page
    page.click("[data-tool=measure]")
    opened.canvas.focus()
    page.keyboard.press("Enter")
    assert opened.said("measure") == "Now the second point."
    page.keyboard.press("Escape")
    assert "Click two points" in opened.said("measure")


def test_a_clicked_camera_shows_its_pictures_and_view(opened: Plate) -> None:
    page, panel = opened.page, opened.page.locator("[data-panel=camera]")
    cameras = opened.scene["cameras"]
    page.check("[data-control=frusta]")
    opened.canvas.focus()
    for _ in range(10):  # so that all of them are in view
        page.keyboard.press("-")
    eye, target = np.array(opened.scene["eye"]), np.array(opened.scene["target"])
    opened.scene["eye"] = (target + (eye - target) / 0.85**10).tolist()
    page.wait_for_timeout(200)
    shown = cameras[2]
    opened.click(shown["center"])
    assert panel.is_visible()
    assert panel.locator("h3").inner_text() == f"Camera {shown['name']}"
    kinds = panel.locator("figure").evaluate_all("all => all.map(e => e.dataset.kind)")
    assert kinds == ["intensity", "AoLP", "reprojected mesh"]
    before = opened.canvas.screenshot()
    page.click("[data-control=through]")
    page.wait_for_timeout(300)
    assert opened.canvas.screenshot() != before
    panel.locator(".thumb").nth(2).click()
    caption = page.locator("dialog output").inner_text()
    assert caption == f"{shown['name']}: reprojected mesh"
    page.keyboard.press("Escape")
    page.click("[data-control=close]")
    assert not panel.is_visible()
    page.select_option("[data-control=camera]", label=cameras[1]["name"])
    assert panel.locator("h3").inner_text() == f"Camera {cameras[1]['name']}"
