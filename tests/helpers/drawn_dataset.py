"""Small datasets without a renderer: shaded cratered terrain, seen from the poses in the manifest.

The terrain is a plane, textured with the shading of a height field. So the position of each pixel in O_L is exact, and
images, poses, labels and times are consistent.
"""

import hashlib
import json
from collections.abc import Collection, Mapping
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

import perilune_shared
from perilune_shared.content import content_sha256
from perilune_shared.dataset.index import FOLDER, index_rows, write_index
from perilune_shared.dataset.info_file import INFO_NAME, with_own_hash, write_info
from perilune_shared.dataset.metadata import CameraRecord, Counts, DatasetInfo, Recipe, recipes_of
from perilune_shared.dataset.names import WHOLE_TABLE
from perilune_shared.dataset.parts import WrittenFile, write_part
from perilune_shared.dataset.schema import OPTIONAL_TABLES, SCHEMA_VERSION, TABLES
from perilune_shared.geometry import frames
from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY, Camera, camera_from_site
from perilune_shared.geometry.ellipse import project_circles
from perilune_shared.geometry.gravity import gravity_mps2
from perilune_shared.geometry.nominal_trajectory import NominalTrajectory
from perilune_shared.storage.files import is_plain
from perilune_shared.storage.locks import LOCK_NAME
from perilune_shared.storage.store import open_store

_TEXEL_M = 2.0
_GROUND_TEXELS = 1400
_SUN_ELEVATION_DEG = 30.0
_PARABOLA = {"start_altitude_m": 1400.0, "end_altitude_m": 400.0, "downrange_m": 250.0, "duration_s": 40.0}


class _Ground:
    """Craters on a plane and its brightness texture; every fourth crater is eroded."""

    def __init__(
        self,
        rng: np.random.Generator,
        count: int,
        removed: Collection[int] = (),
        depth_share: float = 0.0,
        sun_offset_deg: float = 0.0,
    ):
        self.diameter_m = np.sort(np.clip(25.0 * (1 - rng.random(count)) ** -0.6, 25.0, 400.0))[::-1]
        half = _GROUND_TEXELS * _TEXEL_M / 2
        self.xy_m = rng.uniform(-half, half, (count, 2))
        worn = np.arange(count) % 4 == 3
        self.depth_m = self.diameter_m * np.where(worn, 0.01, 0.15)
        self.depth_m[list(removed)] *= depth_share
        axis = (np.arange(_GROUND_TEXELS) + 0.5) * _TEXEL_M - half
        height = cv2.GaussianBlur(rng.standard_normal((_GROUND_TEXELS, _GROUND_TEXELS)).astype(np.float32), (0, 0), 2)
        height *= 0.8
        for (x, y), diameter, depth in zip(self.xy_m, self.diameter_m, self.depth_m, strict=True):
            columns = np.flatnonzero(np.abs(axis - x) < 1.2 * diameter)
            rows = np.flatnonzero(np.abs(axis - y) < 1.2 * diameter)
            r = np.hypot(axis[columns][None] - x, axis[rows][:, None] - y) / (diameter / 2)
            bowl = np.where(r < 1, depth * (r**2 - 0.8), 0.2 * depth * np.maximum(r, 1) ** -4.0)
            height[np.ix_(rows, columns)] += bowl
        self.sun_azimuth_deg = (float(rng.uniform(0, 360)) + sun_offset_deg) % 360
        self.sun = frames.sun_direction(self.sun_azimuth_deg, _SUN_ELEVATION_DEG)
        slope_y, slope_x = np.gradient(height, _TEXEL_M)
        light = (self.sun[2] - slope_x * self.sun[0] - slope_y * self.sun[1]) / np.sqrt(1 + slope_x**2 + slope_y**2)
        self.texture = np.clip(light, 0, None).astype(np.float32)

    def photograph(
        self, camera: Camera, position_m: np.ndarray, rotation: np.ndarray, rng: np.random.Generator
    ) -> np.ndarray:
        rays = camera.rays(camera.pixel_centres()) @ rotation
        points = position_m[:2] + rays[..., :2] * (-position_m[2] / rays[..., 2])[..., None]
        texel = (points / _TEXEL_M + _GROUND_TEXELS / 2 - 0.5).astype(np.float32)
        light = cv2.remap(self.texture, texel[..., 0], texel[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        grey = 160 * light + rng.standard_normal(light.shape)
        return np.clip(np.round(grey), 0, 255).astype(np.uint8)


def _table(name: str, rows: list[dict]) -> pa.Table:
    return pa.Table.from_pylist(rows, schema=TABLES[name])


def build_dataset(
    root: Path,
    kind: str,
    *,
    side_px: int = 96,
    splits: dict[str, int] | None = None,
    scenes: int | None = None,
    n_frames: int = 8,
    craters: int = 220,
    seed: int = 7,
    jitter_m: float = 4.0,
    jitter_deg: float = 0.3,
    removed: Mapping[str, Collection[int]] | None = None,
    depth_share: float = 0.0,
    sun_offset_deg: float = 0.0,
) -> Path:
    """Write a dataset with a number of trajectories for each split in `splits`.

    Each trajectory has its own terrain, unless `scenes` gives the number of terrains. `removed` are craters by scene
    that keep a share of their depth; their labels and all else stay. `sun_offset_deg` turns the Sun.
    """
    splits = splits or {"train": 3, "val": 1, "test": 1}
    camera = Camera.from_field_of_view(side_px, side_px, 40.0)
    names = [split for split, count in splits.items() for _ in range(count)]
    recipe = Recipe(
        preset="tiny",
        kind=kind,
        seed=seed,
        config={"counterfactual": {"depth_share": depth_share}} if depth_share else {},
        versions={"perilune_shared": perilune_shared.__version__},
    )
    grounds: dict[str, _Ground] = {}
    rows: dict[str, list[dict]] = {name: [] for name in TABLES}
    for number, split in enumerate(names):
        scene = f"s{number if scenes is None else number % scenes:03d}"
        trajectory = f"t{number:03d}"
        rng = np.random.default_rng([seed, number])
        if scene not in grounds:
            grounds[scene] = _Ground(
                np.random.default_rng([seed, 1000, int(scene[1:])]),
                craters,
                (removed or {}).get(scene, ()),
                depth_share,
                sun_offset_deg,
            )
            _add_scene(rows, scene, grounds[scene], recipe.key)
        nominal = NominalTrajectory.parabola(**_PARABOLA, azimuth_deg=float(rng.uniform(0, 360)))
        rows["trajectories"].append(
            {
                "scene_id": scene,
                "trajectory_id": trajectory,
                "seed": number,
                "n_frames": n_frames,
                "split": split,
                "nominal_position_m": nominal.position_m,
                "nominal_velocity_mps": nominal.velocity_mps,
                "nominal_acceleration_mps2": nominal.acceleration_mps2,
                "duration_s": nominal.duration_s,
            }
        )
        wobble = np.cumsum(rng.standard_normal((n_frames, 6)), axis=0)
        wobble /= max(wobble.std(), 1e-9)
        for k, time_s in enumerate(np.linspace(0, nominal.duration_s, n_frames)):
            position = nominal.position_at(time_s) + jitter_m * wobble[k, :3]
            tilt = frames.matrix_from_rotation_vector(np.radians(jitter_deg) * wobble[k, 3:])
            rotation = tilt @ ROTATION_CAMERA_FROM_BODY
            frame = f"{scene}/{trajectory}/{k:06d}"
            path = root / "frames" / f"{frame}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), grounds[scene].photograph(camera, position, rotation, rng))
            content = path.read_bytes()
            rows["frames"].append(
                {
                    "frame_id": frame,
                    "scene_id": scene,
                    "trajectory_id": trajectory,
                    "frame_index": k,
                    "time_s": float(time_s),
                    "split": split,
                    "width_px": side_px,
                    "height_px": side_px,
                    "fx_px": camera.fx_px,
                    "fy_px": camera.fy_px,
                    "cx_px": camera.cx_px,
                    "cy_px": camera.cy_px,
                    "position_m": position,
                    "rotation_wxyz": frames.quaternion_from_matrix(rotation),
                    "velocity_mps": nominal.velocity_at(time_s),
                    "sun_direction": grounds[scene].sun,
                    "png_path": f"frames/{frame}.png",
                    "png_sha256": hashlib.sha256(content).hexdigest(),
                    "png_bytes": len(content),
                }
            )
            _add_labels(rows, frame, split, grounds[scene], camera, position, rotation)
        if kind == "nav":
            _add_measurements(rows, nominal, rows["frames"][-n_frames:])
    tables = {name: _table(name, content_rows) for name, content_rows in rows.items()}
    for scene in rows["scenes"]:
        own = [
            tables[name].filter(pc.equal(tables[name]["scene_id"], scene["scene_id"]))
            for name in ("craters", "boulders")
        ]
        scene["content_sha256"] = content_sha256(*own)
    tables["scenes"] = _table("scenes", rows["scenes"])
    for name, table in tables.items():
        if len(table) or name not in OPTIONAL_TABLES:
            write_part(root, name, WHOLE_TABLE, table)
    info = DatasetInfo(
        name="test",
        kind=kind,
        schema_version=SCHEMA_VERSION,
        complete=True,
        images="files",
        split_by="scene" if scenes is None else "trajectory",
        camera=CameraRecord.of(camera),
        recipes=recipes_of(recipe),
        counts=Counts(**{name: len(table) for name, table in tables.items()}),
        licence="CC0-1.0",
    )
    write_info(root, info)
    seal(root)
    return root


_turned = frames.matrix_from_rotation_vector


def _add_measurements(rows: dict[str, list[dict]], nominal: NominalTrajectory, own: list[dict]) -> None:
    """Five measurements between two frames: of the true constant turn, and of the nominal force and altitude."""
    force = np.array(nominal.acceleration_mps2) - gravity_mps2(0.0)
    keys = {key: own[0][key] for key in ("scene_id", "trajectory_id")}
    # The body is turned against the site by R_site_from_body = R_camera_from_site^T R_camera_from_body.
    body = [frames.matrix_from_quaternion(row["rotation_wxyz"]).T @ ROTATION_CAMERA_FROM_BODY for row in own]
    for k in range(len(own) - 1):
        start_s, interval_s = own[k]["time_s"], (own[k + 1]["time_s"] - own[k]["time_s"]) / 5
        rate = frames.rotation_vectors(body[k].T @ body[k + 1]) / (5 * interval_s)
        for part in range(1, 6):
            time_s = start_s + part * interval_s
            rows["ranges"].append(keys | {"time_s": time_s, "range_m": nominal.position_at(time_s)[2]})
            unit = {"grade": "tactical", "time_s": time_s, "interval_s": interval_s}
            rows["inertial"].append(keys | unit | {"angular_rate_radps": rate, "specific_force_mps2": force})
            attitude = frames.quaternion_from_matrix((body[k] @ _turned(rate * part * interval_s)).T)
            rows["star_tracker"].append(keys | {"time_s": time_s, "rotation_wxyz": attitude})
            down = {"beam": 0, "time_s": time_s, "beam_in_body": [0.0, 0.0, -1.0]}
            rows["doppler_lidar"].append(keys | down | {"speed_mps": -nominal.velocity_at(time_s)[2], "range_m": None})


def seal(root: Path) -> None:
    """Write a valid index of all files, and a valid hash of dataset.json, which may have any other content."""
    store, info = open_store(root), root / INFO_NAME
    for old in (root / FOLDER).glob("*.parquet"):
        old.unlink()
    if not info.is_file() or info.is_symlink():
        return
    content = json.loads(info.read_bytes())
    content.pop("sha256", None)
    content["index"] = []
    if content["complete"]:
        paths = [item.path for item in store.list() if is_plain(item.path) and item.path not in (INFO_NAME, LOCK_NAME)]
        plain = [path for path in paths if (root / path).is_file() and not (root / path).is_symlink()]
        rows = index_rows(WrittenFile(path, (root / path).stat().st_size, store.sha256(path)) for path in plain)
        content["index"] = [part.model_dump() for part in write_index(store, rows)]
    info.write_bytes(with_own_hash(json.dumps(content, indent=2).encode()))


def _add_scene(rows: dict[str, list[dict]], scene: str, ground: _Ground, recipe: str) -> None:
    rows["scenes"].append(
        {
            "scene_id": scene,
            "seed": 0,
            "latitude_deg": -80.0,
            "longitude_deg": 0.0,
            "sun_azimuth_deg": ground.sun_azimuth_deg,
            "sun_elevation_deg": _SUN_ELEVATION_DEG,
            "photometry": "lambert",
            "dem_source": "procedural",
            "extent_m": _GROUND_TEXELS * _TEXEL_M,
            "recipe": recipe,
            "content_sha256": "",
        }
    )
    latitude, longitude = frames.selenographic_from_site(*ground.xy_m.T, -80.0, 0.0)
    for index, ((x, y), diameter, depth) in enumerate(zip(ground.xy_m, ground.diameter_m, ground.depth_m, strict=True)):
        rows["craters"].append(
            {
                "scene_id": scene,
                "crater_id": index,
                "x_m": x,
                "y_m": y,
                "z_m": 0.0,
                "normal_x": 0.0,
                "normal_y": 0.0,
                "normal_z": 1.0,
                "diameter_m": diameter,
                "depth_m": depth,
                "fresh_depth_m": 0.2 * diameter,
                "age_myr": 1.0,
                "origin": "primary",
                "latitude_deg": latitude[index],
                "longitude_deg": longitude[index],
            }
        )


def _add_labels(
    rows: dict[str, list[dict]],
    frame: str,
    split: str,
    ground: _Ground,
    camera: Camera,
    position: np.ndarray,
    rotation: np.ndarray,
) -> None:
    centres = camera_from_site(np.column_stack([ground.xy_m, np.zeros(len(ground.xy_m))]), position, rotation)
    normals = np.tile(rotation[:, 2], (len(centres), 1))
    ellipses = project_circles(camera, centres, normals, ground.diameter_m / 2)
    boxes, radius = ellipses.bounding_boxes(), ellipses.radius_px()
    seen = camera.inside(camera.project(centres)) & (radius >= 2) & (radius <= 50)
    for i in np.flatnonzero(seen):
        rows["labels"].append(
            {
                "frame_id": frame,
                "scene_id": frame.partition("/")[0],
                "split": split,
                "crater_id": int(i),
                "ellipse_cx_px": ellipses.cx_px[i],
                "ellipse_cy_px": ellipses.cy_px[i],
                "ellipse_a_px": ellipses.a_px[i],
                "ellipse_b_px": ellipses.b_px[i],
                "ellipse_theta_rad": ellipses.theta_rad[i],
                "bbox_x0_px": boxes[i, 0],
                "bbox_y0_px": boxes[i, 1],
                "bbox_x1_px": boxes[i, 2],
                "bbox_y1_px": boxes[i, 3],
                "radius_px": radius[i],
                "visible_fraction": 1.0,
                "sunlit_fraction": 1.0,
                "contrast": 1.0 if i % 4 == 3 else 20.0,
            }
        )
