"""The tables of a dataset: type, unit and frame of reference of each column (schema version 4).

Real columns of labels are float32, which resolves 0.0001 px in an image of 1024 pixels; no rim can be located that
precisely. Poses, craters and times are float64, since ellipses are computed from them to 0.000001 px.

Every Parquet file contains these units and meanings as metadata, so a single file documents itself.
"""

import pyarrow as pa

SCHEMA_VERSION = "4"
_TEXT, _REAL, _SHORT_REAL, _INTEGER = pa.string(), pa.float64(), pa.float32(), pa.int64()


def complete(table: str, rows: pa.Table) -> pa.Table:
    """Return `rows` with exactly the table's columns, in order and with their types.

    Missing columns become null if `MAY_BE_ABSENT` lists them. Raises pyarrow's error if another column is missing or a
    column cannot be cast to its type.
    """
    for name in MAY_BE_ABSENT.get(table, ()):
        if name not in rows.column_names:
            rows = rows.append_column(name, pa.nulls(len(rows), TABLES[table].field(name).type))
    return rows.select(TABLES[table].names).cast(TABLES[table])


def stored(table: str, rows: pa.Table) -> pa.Table:
    """Return `rows` as they are written to files.

    All columns are present (`complete`), except columns of `ONLY_IF_USED` without any value.
    """
    rows = complete(table, rows)
    unused = [name for name in ONLY_IF_USED.get(table, ()) if rows[name].null_count == len(rows)]
    return rows.drop_columns(unused) if unused else rows


def _vector(length: int) -> pa.DataType:
    return pa.list_(_REAL, length)


def _column(name: str, kind: pa.DataType, unit: str, meaning: str, *, nullable: bool = False) -> pa.Field:
    return pa.field(name, kind, nullable=nullable, metadata={"unit": unit, "meaning": meaning})


def _table(name: str, *columns: pa.Field) -> pa.Schema:
    return pa.schema(columns, metadata={"perilune.table": name, "perilune.schema_version": SCHEMA_VERSION})


_SCENE = _column("scene_id", _TEXT, "", "the terrain")
_TRAJECTORY = _column("trajectory_id", _TEXT, "", "the descent within its scene")
_FRAME = _column("frame_id", _TEXT, "", "scene_id/trajectory_id/frame_index with 6 digits")
_SPLIT = "train, val or test"
ANGULAR_VELOCITY = ("wx_radps", "wy_radps", "wz_radps")
"""Columns of the camera's angular velocity in `frames`.

There is no single list column, since Parquet readers fail on nullable lists."""

TABLES: dict[str, pa.Schema] = {
    "scenes": _table(
        "scenes",
        _SCENE,
        _column("seed", _INTEGER, "", "seed of the scene's own random streams"),
        _column("latitude_deg", _REAL, "deg", "of the site, O_S, north positive"),
        _column("longitude_deg", _REAL, "deg", "of the site, O_S, east positive"),
        _column("sun_azimuth_deg", _REAL, "deg", "clockwise from north"),
        _column("sun_elevation_deg", _REAL, "deg", "above the site's ground plane"),
        _column("photometry", _TEXT, "", "name of the reflectance law and parameter set"),
        _column("dem_source", _TEXT, "", "name and SHA-256 of the elevation model, or 'procedural'"),
        _column("extent_m", _REAL, "m", "side of the square terrain, centred on the site"),
        _column("recipe", _TEXT, "", "what it was made by: a key of `recipes` in dataset.json"),
        _column("content_sha256", _TEXT, "", "of its craters and boulders to a millimetre (perilune_shared.content)"),
        _column("hazard_path", _TEXT, "", "hazard map, relative to the dataset; null if none", nullable=True),
        _column("hazard_sha256", _TEXT, "", "of the whole file; null where not written", nullable=True),
        _column("hazard_bytes", _INTEGER, "B", "file size; null where not written", nullable=True),
    ),
    "craters": _table(
        "craters",
        _SCENE,
        _column("crater_id", _INTEGER, "", "unique within the scene"),
        _column("x_m", _REAL, "m", "rim circle's centre, O_L"),
        _column("y_m", _REAL, "m", "rim circle's centre, O_L"),
        _column("z_m", _REAL, "m", "rim circle's centre, O_L, measured on the finished height field"),
        _column("normal_x", _REAL, "", "rim circle's unit normal, O_L"),
        _column("normal_y", _REAL, "", "rim circle's unit normal, O_L"),
        _column("normal_z", _REAL, "", "rim circle's unit normal, O_L"),
        _column("diameter_m", _REAL, "m", "rim crest to rim crest"),
        _column("depth_m", _REAL, "m", "rim to floor on the finished height field, less the sag of older ground"),
        _column("fresh_depth_m", _REAL, "m", "rim to floor when it formed; null where not known", nullable=True),
        _column("age_myr", _REAL, "Myr", "time since it formed; null where not known", nullable=True),
        _column(
            "origin", _TEXT, "", "primary, secondary (drawn in a cluster), or elevation model (real, from a catalogue)"
        ),
        _column("latitude_deg", _REAL, "deg", "O_S"),
        _column("longitude_deg", _REAL, "deg", "O_S"),
        _column(
            "catalogue_diameter_m",
            _REAL,
            "m",
            "as the catalogue lists it; null unless rims of the catalogue were measured in the elevation model",
            nullable=True,
        ),
        _column(
            "rim_rms_share",
            _REAL,
            "",
            "r.m.s. distance of the measured crest from its ellipse, divided by its radius; null where not measured",
            nullable=True,
        ),
        _column(
            "rim_axis_ratio",
            _REAL,
            "",
            "minor axis of this ellipse divided by the major axis; null where not measured",
            nullable=True,
        ),
    ),
    "boulders": _table(
        "boulders",
        _SCENE,
        _column("boulder_id", _INTEGER, "", "unique within the scene"),
        _column("x_m", _REAL, "m", "centre, O_L"),
        _column("y_m", _REAL, "m", "centre, O_L"),
        _column("z_m", _REAL, "m", "centre, O_L"),
        _column("diameter_m", _REAL, "m", "mean of the three axes"),
        _column("shape_id", _INTEGER, "", "which rock of the scene's set"),
        _column("rotation_wxyz", _vector(4), "", "rotation_site_from_rock, unit quaternion"),
    ),
    "trajectories": _table(
        "trajectories",
        _SCENE,
        _TRAJECTORY,
        _column("seed", _INTEGER, "", "seed of the descent's own random streams"),
        _column("n_frames", _INTEGER, "", "number of frames"),
        _column("split", _TEXT, "", f"{_SPLIT}; null where frames of one descent are split", nullable=True),
        _column("nominal_position_m", _vector(3), "m", "nominal curve at time 0, O_L"),
        _column("nominal_velocity_mps", _vector(3), "m/s", "nominal curve at time 0, O_L"),
        _column("nominal_acceleration_mps2", _vector(3), "m/s^2", "nominal curve, constant, O_L"),
        _column("duration_s", _REAL, "s", "first to last frame"),
    ),
    "frames": _table(
        "frames",
        _FRAME,
        _SCENE,
        _TRAJECTORY,
        _column("frame_index", _INTEGER, "", "place in the descent, from 0"),
        _column("time_s", _REAL, "s", "since the first frame"),
        _column("split", _TEXT, "", _SPLIT),
        _column("width_px", _INTEGER, "px", "image width"),
        _column("height_px", _INTEGER, "px", "image height"),
        _column("fx_px", _REAL, "px", "focal length"),
        _column("fy_px", _REAL, "px", "focal length"),
        _column("cx_px", _REAL, "px", "principal point, origin at the outer corner of the top-left pixel"),
        _column("cy_px", _REAL, "px", "principal point, origin at the outer corner of the top-left pixel"),
        _column("position_m", _vector(3), "m", "camera, O_L"),
        _column("rotation_wxyz", _vector(4), "", "rotation_camera_from_site, unit quaternion"),
        _column("velocity_mps", _vector(3), "m/s", "camera, O_L"),
        _column("sun_direction", _vector(3), "", "unit vector towards the Sun, O_L"),
        _column("png_path", _TEXT, "", "relative to the dataset"),
        _column("png_sha256", _TEXT, "", "of the whole file; null where never rendered", nullable=True),
        _column("png_bytes", _INTEGER, "B", "file size; null where never rendered", nullable=True),
        _column("exr_path", _TEXT, "", "relative to the dataset; null where not written", nullable=True),
        _column("exr_sha256", _TEXT, "", "of the whole file; null where not written", nullable=True),
        _column("exr_bytes", _INTEGER, "B", "file size; null where not written", nullable=True),
        _column(
            "real_ground_share",
            _REAL,
            "",
            "share of the frame's ground that is an elevation model's, not procedural; null where not known",
            nullable=True,
        ),
        _column(
            "n_craters_above_max_radius",
            _INTEGER,
            "",
            "craters with their centre in the image that are too large for a label; null where not known",
            nullable=True,
        ),
        *(
            _column(
                name,
                _REAL,
                "rad/s",
                f"angular velocity of the camera about its {name[1]} axis, O_C; null for 0",
                nullable=True,
            )
            for name in ANGULAR_VELOCITY
        ),
        _column(
            "lidar_path",
            _TEXT,
            "",
            "image of the flash lidar, relative to the dataset; null where not written",
            nullable=True,
        ),
        _column("lidar_sha256", _TEXT, "", "of the whole file; null where not written", nullable=True),
        _column("lidar_bytes", _INTEGER, "B", "file size; null where not written", nullable=True),
        _column(
            "camera",
            _TEXT,
            "",
            "name of the camera: a key of `cameras` in dataset.json; null if the lander has one camera without a name",
            nullable=True,
        ),
    ),
    "labels": _table(
        "labels",
        _FRAME,
        _column("scene_id", _TEXT, "", "the frame's terrain"),
        _column("split", _TEXT, "", f"the frame's: {_SPLIT}"),
        _column("crater_id", _INTEGER, "", "the crater, within the frame's scene"),
        _column("ellipse_cx_px", _SHORT_REAL, "px", "ellipse's centre"),
        _column("ellipse_cy_px", _SHORT_REAL, "px", "ellipse's centre"),
        _column("ellipse_a_px", _SHORT_REAL, "px", "semi-major axis"),
        _column("ellipse_b_px", _SHORT_REAL, "px", "semi-minor axis"),
        _column("ellipse_theta_rad", _SHORT_REAL, "rad", "direction of the semi-major axis, x towards y, [0, pi)"),
        _column("bbox_x0_px", _SHORT_REAL, "px", "tight on the whole ellipse"),
        _column("bbox_y0_px", _SHORT_REAL, "px", "tight on the whole ellipse"),
        _column("bbox_x1_px", _SHORT_REAL, "px", "tight on the whole ellipse"),
        _column("bbox_y1_px", _SHORT_REAL, "px", "tight on the whole ellipse"),
        _column("radius_px", _SHORT_REAL, "px", "sqrt(a b)"),
        _column("visible_fraction", _SHORT_REAL, "", "share of the rim inside the image and not hidden"),
        _column("sunlit_fraction", _SHORT_REAL, "", "share of the crater's seen pixels that the Sun reaches"),
        _column(
            "contrast",
            _SHORT_REAL,
            "",
            "the crater's own shading over its standard error, from noise and clutter; null where not known",
            nullable=True,
        ),
    ),
    "inertial": _table(
        "inertial",
        _SCENE,
        _TRAJECTORY,
        _column("grade", _TEXT, "", "grade of the inertial measurement unit: tactical or navigation"),
        _column("time_s", _REAL, "s", "end of the interval of the measurement, since the first frame"),
        _column("interval_s", _REAL, "s", "length of the interval"),
        _column("angular_rate_radps", _vector(3), "rad/s", "mean angular rate of the body against O_L, measured, O_B"),
        _column("specific_force_mps2", _vector(3), "m/s^2", "mean acceleration without gravity, measured, O_B"),
    ),
    "ranges": _table(
        "ranges",
        _SCENE,
        _TRAJECTORY,
        _column("time_s", _REAL, "s", "since the first frame"),
        _column("range_m", _REAL, "m", "measured distance to ground along -Z_B; null without a return", nullable=True),
    ),
    "star_tracker": _table(
        "star_tracker",
        _SCENE,
        _TRAJECTORY,
        _column("time_s", _REAL, "s", "since the first frame"),
        _column("rotation_wxyz", _vector(4), "", "measured rotation_body_from_site, unit quaternion"),
    ),
    "doppler_lidar": _table(
        "doppler_lidar",
        _SCENE,
        _TRAJECTORY,
        _column("beam", _INTEGER, "", "number of the beam, from 0"),
        _column("time_s", _REAL, "s", "since the first frame"),
        _column("beam_in_body", _vector(3), "", "direction of the beam, unit vector, O_B"),
        _column(
            "speed_mps",
            _REAL,
            "m/s",
            "measured speed over ground along the beam, positive towards the ground; null without a return",
            nullable=True,
        ),
        _column(
            "range_m", _REAL, "m", "measured distance to ground along the beam; null without a return", nullable=True
        ),
    ),
}
OPTIONAL_TABLES = ("inertial", "ranges", "star_tracker", "doppler_lidar")
"""Tables that are written only if they have rows. They were added without a new schema version."""
_HAZARD = ("hazard_path", "hazard_sha256", "hazard_bytes")
_LIDAR = ("lidar_path", "lidar_sha256", "lidar_bytes")
_ABSENT_IN_FRAMES = ("real_ground_share", "n_craters_above_max_radius", *ANGULAR_VELOCITY, *_LIDAR)
_MEASURED_RIM = ("catalogue_diameter_m", "rim_rms_share", "rim_axis_ratio")
MAY_BE_ABSENT: dict[str, tuple[str, ...]] = {
    "scenes": _HAZARD,
    "craters": _MEASURED_RIM,
    "frames": (*_ABSENT_IN_FRAMES, "camera"),
    "shards": _ABSENT_IN_FRAMES,
}
"""Columns that a file may lack, by table; readers then fill them with nulls.

These columns were added without a new schema version. To add another column, append it to its table with
`nullable=True`, and add its name here and to ONLY_IF_USED."""
ONLY_IF_USED: dict[str, tuple[str, ...]] = {
    "scenes": _HAZARD,
    "craters": _MEASURED_RIM,
    "frames": (*ANGULAR_VELOCITY, *_LIDAR, "camera"),
}
"""Columns of MAY_BE_ABSENT that are written only if they have a value.

Datasets without values keep the bytes that they had before the column was added."""
KEYS: dict[str, list[str]] = {
    "scenes": ["scene_id"],
    "craters": ["scene_id", "crater_id"],
    "boulders": ["scene_id", "boulder_id"],
    "trajectories": ["scene_id", "trajectory_id"],
    "frames": ["frame_id"],
    "labels": ["frame_id", "crater_id"],
    "inertial": ["scene_id", "trajectory_id", "grade", "time_s"],
    "ranges": ["scene_id", "trajectory_id", "time_s"],
    "star_tracker": ["scene_id", "trajectory_id", "time_s"],
    "doppler_lidar": ["scene_id", "trajectory_id", "beam", "time_s"],
}
"""Columns that identify a row, by table."""
