"""Packed layers: what the page's viewer will unpack is what was put in, to a known precision."""

import base64
import gzip

import numpy as np
import pytest

from polmvs.camera import PinholeCamera
from polmvs.geometry import RigidTransform
from polmvs.report.layers import KIND, BoxFrame, Layer, PointColoring, pack_scene, thinned
from polmvs.scene import PointKind, View

CAMERA = PinholeCamera(width=60, height=40, fx=50, fy=50, cx=30, cy=20)
TYPES = {"uint8": np.uint8, "int8": np.int8, "uint16": np.uint16, "uint32": np.uint32}


def part(scene, number: int, what: dict) -> np.ndarray:
    """A part of a layer's bytes, as viewer.js takes it."""
    data = gzip.decompress(base64.b64decode(scene.blocks[f"layer-{number}"]))
    kind = TYPES[what["type"]]
    assert what["offset"] % 4 == 0
    return np.frombuffer(data, kind, what["length"], what["offset"])


def random_layer(num: int = 500, seed: int = 0) -> Layer:
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(num, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    values = {"sigma": rng.uniform(0, 2, num), "kind": rng.integers(0, 4, num)}
    return Layer(label="a", points=rng.normal(3, 1, (num, 3)), normals=normals, values=values)


def looking_down(x: float) -> View:
    rotation = np.diag([1.0, -1.0, -1.0])
    center = np.array([x, 3.0, 30.0])
    return View(
        name="v", camera=CAMERA, cam_from_world=RigidTransform(rotation, -rotation @ center)
    )


CHANNELS = {"sigma": PointColoring(label="s", unit="mm", high=2.0), "kind": KIND}


def test_round_trip_of_positions_normals_and_channels() -> None:
    layer = random_layer()
    scene = pack_scene([layer], CHANNELS, [], (0, None))
    description = scene.description
    described = description["layers"][0]
    position = part(scene, 0, described["position"]).reshape(-1, 3) / 65535
    points = position * description["extent"] + description["origin"]
    np.testing.assert_allclose(points, layer.points, atol=0.51 * description["extent"] / 65535)
    normals = part(scene, 0, described["normal"]).reshape(-1, 3) / 127
    np.testing.assert_allclose(normals, layer.normals, atol=0.51 / 127)
    sigma = part(scene, 0, described["channels"]["sigma"]) / 255 * 2.0
    np.testing.assert_allclose(sigma, layer.values["sigma"], atol=0.51 * 2 / 255)
    kind = np.floor(part(scene, 0, described["channels"]["kind"]) / 256 * len(PointKind))
    np.testing.assert_array_equal(kind, layer.values["kind"])


def test_layers_share_one_box() -> None:
    one, other = random_layer(seed=1), random_layer(seed=2)
    moved = Layer(label="b", points=other.points + 50, normals=other.normals)
    scene = pack_scene([one, moved], CHANNELS, [], (0, 1))
    far = part(scene, 1, scene.description["layers"][1]["position"]).reshape(-1, 3) / 65535
    found = far * scene.description["extent"] + scene.description["origin"]
    np.testing.assert_allclose(found, moved.points, atol=1e-3)


def test_meshes_keep_their_triangles() -> None:
    triangles = np.array([[0, 1, 2], [2, 1, 3]])
    square = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], float)
    mesh = Layer(
        label="m", points=square, normals=np.tile([0.0, 0, 1], (4, 1)), triangles=triangles
    )
    scene = pack_scene([mesh], {}, [], (0, None))
    found = part(scene, 0, scene.description["layers"][0]["triangles"])
    np.testing.assert_array_equal(found.reshape(-1, 3), triangles)
    assert thinned(mesh, 2) is mesh


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_values_that_are_not_finite_look_worst(bad: float) -> None:
    layer = Layer(
        label="a", points=np.zeros((2, 3)), normals=np.zeros((2, 3)),
        values={"sigma": np.array([0.0, bad])},
    )  # fmt: skip
    scene = pack_scene([layer], CHANNELS, [], (0, None))
    assert part(scene, 0, scene.description["layers"][0]["channels"]["sigma"]).tolist() == [0, 255]


def test_points_without_a_value_have_a_colour_of_their_own() -> None:
    layer = Layer(
        label="a", points=np.zeros((4, 3)), normals=np.zeros((4, 3)),
        values={"sigma": np.array([0.0, np.nan, 9.0, 2.0])},
    )  # fmt: skip
    channels = {"sigma": PointColoring(label="s", high=2.0, colors="plasma", may_lack=True)}
    scene = pack_scene([layer], channels, [], (0, None))
    found = part(scene, 0, scene.description["layers"][0]["channels"]["sigma"])
    assert found.tolist() == [0, 255, 254, 254]
    assert scene.description["channels"]["sigma"]["unknown"].startswith("#")


def test_thinning_takes_all_parts_of_the_cloud_alike() -> None:
    layer = random_layer(10_000)
    few = thinned(layer, 1000)
    assert len(few.points) == len(few.normals) == len(few.values["sigma"]) == 1000
    np.testing.assert_allclose(few.points.mean(axis=0), layer.points.mean(axis=0), atol=0.15)
    assert thinned(layer, 10_000) is layer


def test_up_is_where_the_cameras_are_and_the_eye_sees_the_part() -> None:
    layer = random_layer()
    scene = pack_scene([layer], CHANNELS, [looking_down(2.0), looking_down(4.0)], (0, None))
    d = scene.description
    np.testing.assert_allclose(d["up"], [0, 0, 1], atol=0.05)
    distance = np.linalg.norm(np.subtract(d["eye"], d["target"]))
    assert 2 * d["radius"] < distance < 5 * d["radius"]
    np.testing.assert_allclose(np.linalg.norm(np.reshape(d["basis"], (3, 3)), axis=1), 1)


def test_cameras_stand_where_they_are_and_look_where_they_do() -> None:
    scene = pack_scene([random_layer()], CHANNELS, [looking_down(2.0)], (0, None))
    (camera,) = scene.description["cameras"]
    assert camera["name"] == "v"
    np.testing.assert_allclose(camera["center"], [2, 3, 30])
    np.testing.assert_allclose(camera["forward"], [0, 0, -1], atol=1e-9)
    corners = np.array(camera["corners"]) - camera["center"]
    assert (corners[:, 2] < 0).all()  # they look down
    assert (corners[[0, 3], 0] < 0).all()  # of the image's left side
    assert (corners[[0, 1], 1] > 0).all()  # and its top, for up in the image is +y here
    np.testing.assert_allclose(camera["half_field"], [30 / 50, 20 / 50])


def test_frames_of_boxes_begin_with_the_model_s() -> None:
    turn = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    marker = BoxFrame("marker 3", "--box-marker=3", RigidTransform(turn, np.array([1.0, 2, 3])))
    scene = pack_scene([random_layer()], CHANNELS, [], (0, None), frames=[marker])
    model, other = scene.description["frames"]
    np.testing.assert_array_equal(np.reshape(model["matrix"], (4, 4)), np.eye(4))
    assert (model["option"], other["option"]) == ("", "--box-marker=3")
    point = np.array([0.3, -0.2, 0.7])
    found = np.reshape(other["matrix"], (4, 4)) @ [*point, 1]
    np.testing.assert_allclose(found[:3], turn @ point + [1, 2, 3])


def test_the_target_is_on_the_polarized_surface() -> None:
    rng = np.random.default_rng(0)
    surface, around = rng.normal(0, 0.1, (50, 3)), rng.normal(9, 0.1, (500, 3))
    kind = np.r_[np.full(50, PointKind.SURFACE), np.full(500, PointKind.SPARSE)]
    points = np.concatenate([surface, around])
    layer = Layer(label="a", points=points, normals=np.zeros_like(points), values={"kind": kind})
    scene = pack_scene([layer], CHANNELS, [], (0, None))
    np.testing.assert_allclose(scene.description["target"], 0, atol=0.2)
    assert scene.description["radius"] < 1


def test_the_same_scene_is_the_same_text() -> None:
    one, two = (pack_scene([random_layer()], CHANNELS, [], (0, None)) for _ in range(2))
    assert one == two
