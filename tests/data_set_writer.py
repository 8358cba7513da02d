"""Public data sets written in their real layout from linear mosaics, views and masks by stem."""

import cv2
import numpy as np
from capture_writer import PATTERN, split_mosaic, stokes_of

from polmvs.colmap.models import reconstruction_of_views, write_reconstruction
from polmvs.scene import View


def opencv_matrix(view):
    K = view.camera.K.copy()
    K[:2, 2] -= 0.5
    return K


def world_mat(view):
    pose = np.column_stack([view.cam_from_world.rotation, view.cam_from_world.translation])
    return np.vstack([3.7 * opencv_matrix(view) @ pose, [0, 0, 0, 1]])  # of any scale


def save_masks(folder, source, stems):
    folder.mkdir()
    for stem, (_, _, mask) in zip(stems, source.values(), strict=True):
        cv2.imwrite(str(folder / f"{stem}.png"), 255 * mask.astype(np.uint8))


def save_sparse(folder, source, stems):
    folder.parent.mkdir()
    views = [
        View(name=f"{stem}.png", camera=view.camera, cam_from_world=view.cam_from_world)
        for stem, (_, view, _) in zip(stems, source.values(), strict=True)
    ]
    write_reconstruction(reconstruction_of_views(views), folder)


def colours(image):
    """Three channels whose mean is the image, times a half as the sets have it."""
    return 0.5 * np.dstack([0.8 * image, image, 1.2 * image]).astype(np.float32)


def ppa4p3d(root, source):
    (root / "images").mkdir(parents=True)
    (root / "cams").mkdir()
    stems = [f"{k:08d}" for k in range(len(source))]
    for stem, (share, view, _) in zip(stems, source.values(), strict=True):
        cv2.imwrite(
            str(root / "images" / f"{stem}.png"), np.rint(255 * np.sqrt(share)).astype(np.uint8)
        )
        pose = np.eye(4)
        pose[:3] = np.column_stack([view.cam_from_world.rotation, view.cam_from_world.translation])
        lines = ["extrinsic", *(" ".join(map(repr, map(float, row))) for row in pose), ""]
        K = opencv_matrix(view)
        lines += ["intrinsic", *(" ".join(map(repr, map(float, row))) for row in K), ""]
        (root / "cams" / f"{stem}_cam.txt").write_text("\n".join([*lines, "0.2 0.01 100 1.2", ""]))
    return stems


def pisr_cameras(root, source):
    _, view, _ = next(iter(source.values()))
    np.savez(root / "intrinsics.npz", camera_matrix=opencv_matrix(view), dist_coeffs=np.zeros(5))
    mats = {f"world_mat_{k}": world_mat(v) for k, (_, v, _) in enumerate(source.values())}
    mats |= {f"scale_mat_{k}": np.eye(4) for k in range(len(source))}
    np.savez(root / "cameras_sphere.npz", **mats)


def pisr(root, source):
    (root / "raw").mkdir(parents=True)
    stems = [f"{k:03d}" for k in range(len(source))]
    for stem, (share, _, _) in zip(stems, source.values(), strict=True):
        np.save(root / "raw" / f"{stem}.npy", np.rint(4095 * np.sqrt(share)).astype(np.uint16))
    pisr_cameras(root, source)
    (root / "gamma0.5.txt").write_text("")
    save_masks(root / "mask", source, stems)
    return stems


def pisr_maps(root, source):
    stems = [f"{k:03d}" for k in range(len(source))]
    for name in ("aop", "dop", "image"):
        (root / name).mkdir(parents=True)
    for stem, (share, _, _) in zip(stems, source.values(), strict=True):
        s = stokes_of(share)
        np.save(root / "aop" / f"{stem}.npy", 0.5 * np.arctan2(s["s2"], s["s1"]))
        np.save(root / "dop" / f"{stem}.npy", np.hypot(s["s1"], s["s2"]) / s["s0"].clip(1e-6))
        rgb = np.clip(np.rint(colours(s["s0"]) * 255), 0, 255).astype(np.uint8)
        cv2.imwrite(str(root / "image" / f"{stem}.png"), rgb)
    pisr_cameras(root, source)
    return stems


def pandora(root, source):
    (root / "images_stokes").mkdir(parents=True)
    stems = [f"{k + 1:02d}" for k in range(len(source))]
    for stem, (share, _, _) in zip(stems, source.values(), strict=True):
        s = stokes_of(share)
        for name, image in (
            ("s0", s["s0"]),
            ("s0p1", s["s0"] + s["s1"]),
            ("s0p2", s["s0"] + s["s2"]),
        ):
            cv2.imwrite(str(root / "images_stokes" / f"{stem}_{name}.hdr"), colours(image))
    save_masks(root / "mask", source, stems)
    save_sparse(root / "sparse" / "0", source, stems)
    return stems


def nersp(root, source):
    stems = [f"{k:04d}" for k in range(len(source))]
    for name in ("s0", "s1", "s2", "image", "input_azimuth_maps"):
        (root / name).mkdir(parents=True)
    for stem, (share, _, mask) in zip(stems, source.values(), strict=True):
        s = stokes_of(share)
        for name in ("s0", "s1", "s2"):
            np.save(root / name / f"{stem}.npy", colours(s[name]))
        rgba = np.zeros((*mask.shape, 4), np.uint16)
        rgba[..., 3] = 65535 * mask
        cv2.imwrite(str(root / "input_azimuth_maps" / f"{stem}.png"), rgba)
        cv2.imwrite(str(root / "image" / f"{stem}.png"), np.zeros(mask.shape, np.uint8))
    mats = {f"world_mat_{k}": world_mat(v) for k, (_, v, _) in enumerate(source.values())}
    np.savez(root / "cameras.npz", **mats, scale_mat_0=np.eye(4))
    return stems


def mvas(root, source):
    stems = [f"{k:02d}" for k in range(len(source))]
    (root / "input_azimuth_maps").mkdir(parents=True)
    (root / "images").mkdir()
    for stem, (share, _, _) in zip(stems, source.values(), strict=True):
        s = stokes_of(share)
        azimuth = np.mod(-0.5 * np.arctan2(s["s2"], s["s1"]), np.pi)  # clockwise
        cv2.imwrite(
            str(root / "input_azimuth_maps" / f"{stem}.png"),
            np.rint(azimuth / np.pi * 65535).astype(np.uint16),
        )
        gray = np.clip(np.rint(s["s0"] * 255), 0, 255).astype(np.uint8)
        cv2.imwrite(str(root / "images" / f"{stem}.png"), gray)
    save_masks(root / "mask", source, stems)
    save_sparse(root / "sparse" / "0", source, stems)
    return stems


def neus(root, source, mosaics=False):
    """Four images a view, or mosaics whose cameras are of their size; cameras by number."""
    (root / "raw").mkdir(parents=True)
    content = {}
    for index, (stem, (share, view, _)) in enumerate(source.items()):
        matrix = world_mat(view)
        if mosaics:
            # u' = 2 u + 0.5 where u counts from the centre of the first pixel.
            matrix = np.array([[2, 0, 0.5, 0], [0, 2, 0.5, 0], [0, 0, 1, 0], [0, 0, 0, 1]]) @ matrix
            cv2.imwrite(str(root / "raw" / f"{stem}.png"), np.rint(65535 * share).astype(np.uint16))
        else:
            save_angles(root / "raw" / (stem + "_{angle}.png"), share)
        content |= {f"world_mat_{index}": matrix, f"scale_mat_{index}": np.eye(4)}
    np.savez(root / "cameras_sphere.npz", **content)
    save_masks(root / "masks", source, list(source))
    return list(source)


def save_angles(template, share):
    for angle, image in zip((0, 45, 90, 135), split_mosaic(share, PATTERN), strict=True):
        path = str(template).format(angle=f"{angle:02d}")
        assert cv2.imwrite(path, np.rint(65535 * np.clip(image, 0, 1)).astype(np.uint16))


def transpir(root, source):
    for angle in ("00", "45", "90", "135"):
        (root / f"I-{angle}").mkdir(parents=True)
    (root / "I-sum").mkdir()
    content = {}
    for index, (stem, (share, view, _)) in enumerate(source.items()):
        save_angles(str(root / "I-{angle}" / f"{stem}.png"), share)
        (root / "I-sum" / f"{stem}.png").write_bytes((root / "I-00" / f"{stem}.png").read_bytes())
        content |= {f"world_mat_{index}": world_mat(view), f"scale_mat_{index}": np.eye(4)}
    np.savez(root / "cameras_new.npz", **content)
    (root / "masks").mkdir()
    for stem, (_, _, mask) in source.items():
        cv2.imwrite(str(root / "masks" / f"{stem}_pseudo.png"), 255 * mask.astype(np.uint8))
    return list(source)
