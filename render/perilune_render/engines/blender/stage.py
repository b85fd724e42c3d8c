"""Build a Blender scene (the stage): ground, boulders, Sun, Earth, camera, materials."""

import bpy
import numpy as np
from mathutils import Matrix

from perilune_render.config.dataset import DatasetConfig, LightConfig
from perilune_render.engines.blender.nodes import Symbol, at_least, dot
from perilune_render.terrain.boulders import boulder_mesh
from perilune_render.terrain.export import vertices
from perilune_render.terrain.scene import Scene
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.ellipse import plane_basis
from perilune_shared.geometry.frames import Array, earth_direction
from perilune_shared.photometry import reflectance_factor

_BLENDER_FROM_OPENCV = np.diag([1.0, -1.0, -1.0])
"""Axes of Blender's camera: y up, looking along -z."""
_EARTH_ANGULAR_DIAMETER_DEG = 1.9
"""Angular diameter of the Earth at the Moon's mean distance."""
_EARTHSHINE = 0.1 / 1361
"""Irradiance of the full Earth divided by the irradiance of the Sun."""


def clear() -> bpy.types.Scene:
    """Reset Blender to an empty file, which frees the previous scene."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    return bpy.context.scene


def build(scene: Scene, config: DatasetConfig, camera: Camera, sun: Array) -> bpy.types.Scene:
    """Build the stage of a scene lit from the direction `sun` (3,), O_L; `aim` places the camera."""
    stage = sunlit_stage(config.light, camera, sun)
    stage.camera.data.clip_end = scene.grid.farthest_m
    ground = ground_object(scene)
    ground.data.materials.append(surface_material("ground", config.light.photometry, sun, albedo_attribute="albedo"))
    stage.collection.objects.link(ground)
    stone = surface_material("rock", config.light.photometry, sun)
    if len(scene.boulders):
        boulders = boulders_object(scene)
        boulders.data.materials.append(stone)
        stage.collection.objects.link(boulders)
    earth = earth_direction(scene.latitude_deg, scene.longitude_deg)
    if config.light.earthshine and earth[2] > 0:
        stage.collection.objects.link(lamp_object("Earth", earth, _EARTH_ANGULAR_DIAMETER_DEG, _EARTHSHINE))
    return stage


def sunlit_stage(light: LightConfig, camera: Camera, sun: Array) -> bpy.types.Scene:
    """A stage with a black sky, the Sun in the direction `sun` (3,) and the camera, without ground."""
    stage = clear()
    stage.world = bpy.data.worlds.new("sky")
    stage.world.use_nodes = True
    stage.world.node_tree.nodes["Background"].inputs["Strength"].default_value = 0.0
    stage.collection.objects.link(lamp_object("Sun", sun, light.sun_angular_diameter_deg))
    stage.camera = camera_object(camera)
    stage.collection.objects.link(stage.camera)
    return stage


def mesh_from_arrays(name: str, points: np.ndarray, faces: np.ndarray) -> bpy.types.Mesh:
    """A mesh from vertices (V, 3) and faces (F, k)."""
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(len(points))
    # Fill the attributes: Blender copies whole arrays into them. Filling vertices and loops takes 100 times as long.
    mesh.attributes["position"].data.foreach_set("vector", np.ascontiguousarray(points, np.float32).ravel())
    mesh.loops.add(faces.size)
    mesh.attributes[".corner_vert"].data.foreach_set("value", np.ascontiguousarray(faces, np.int32).ravel())
    mesh.polygons.add(len(faces))
    mesh.polygons.foreach_set("loop_start", np.arange(0, faces.size, faces.shape[1], dtype=np.int32))
    # Without an edge, Blender would compute all edges: 2 s for 6 million vertices. Cycles reads no edges.
    mesh.edges.add(1)
    mesh.update()
    return mesh


def ground_object(scene: Scene) -> bpy.types.Object:
    """The ground as one smooth-shaded mesh with its albedo as a vertex attribute."""
    mesh = mesh_from_arrays("ground", vertices(scene.grid, scene.height_m), scene.grid.quads())
    albedo = mesh.attributes.new("albedo", "FLOAT", "POINT")
    albedo.data.foreach_set("value", np.ascontiguousarray(scene.albedo, np.float32))
    return bpy.data.objects.new("ground", mesh)


def boulders_object(scene: Scene) -> bpy.types.Object:
    """All boulders as one flat-shaded mesh."""
    mesh = mesh_from_arrays("boulders", *boulder_mesh(scene.boulders, scene.boulder_z_m, scene.grid, scene.seed))
    mesh.shade_flat()
    return bpy.data.objects.new("boulders", mesh)


def surface_material(name: str, law: str, sun: Array, albedo_attribute: str | None = None) -> bpy.types.Material:
    """A material whose radiance under the lamp "Sun" equals the radiance factor of a reflectance law.

    Cycles multiplies a diffuse colour by mu0 / pi and by the Sun's irradiance, here pi. The colour for the radiance I/F
    is therefore I/F divided by mu0, evaluated at the shading point. Approximation: the colour for the Sun's direction
    also serves as diffuse albedo for light from the Earth and from other ground.
    """
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    geometry = tree.nodes.new("ShaderNodeNewGeometry")
    mu0 = at_least(dot(tree, geometry.outputs["Normal"], tuple(sun)), 1e-4)
    mu = at_least(dot(tree, geometry.outputs["Normal"], geometry.outputs["Incoming"]), 1e-4)
    cos_phase = dot(tree, geometry.outputs["Incoming"], tuple(sun))
    colour = reflectance_factor(law, mu0, mu, cos_phase)
    if albedo_attribute is not None:
        attribute = tree.nodes.new("ShaderNodeAttribute")
        attribute.attribute_name = albedo_attribute
        colour = colour * Symbol(tree, attribute.outputs["Fac"])
    diffuse = tree.nodes.new("ShaderNodeBsdfDiffuse")
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(colour.socket, diffuse.inputs["Color"])
    tree.links.new(diffuse.outputs["BSDF"], output.inputs["Surface"])
    return material


def lamp_object(name: str, towards: Array, angular_diameter_deg: float, suns: float = 1.0) -> bpy.types.Object:
    """A lamp at infinity of irradiance `suns` x pi.

    With irradiance pi, the rendered radiance equals the radiance factor.
    """
    lamp = bpy.data.lights.new(name, "SUN")
    lamp.energy = suns * np.pi
    lamp.angle = np.radians(angular_diameter_deg)
    item = bpy.data.objects.new(name, lamp)
    x, y = plane_basis(towards)
    item.matrix_world = Matrix(np.stack([x, y, towards], axis=1).tolist()).to_4x4()
    return item


def camera_object(camera: Camera) -> bpy.types.Object:
    """A Blender camera with these intrinsics."""
    lens = bpy.data.cameras.new("camera")
    lens.sensor_fit = "HORIZONTAL"
    lens.sensor_width = 36.0
    lens.lens = camera.fx_px / camera.width_px * 36.0
    lens.shift_x = (camera.width_px / 2 - camera.cx_px) / camera.width_px
    lens.shift_y = (camera.cy_px - camera.height_px / 2) / camera.width_px * camera.fx_px / camera.fy_px
    lens.clip_start, lens.clip_end = 0.1, 100_000.0
    return bpy.data.objects.new("camera", lens)


def aim(stage: bpy.types.Scene, position_m: Array, rotation_camera_from_site: Array) -> None:
    """Set the pose of the stage's camera."""
    rotation_site_from_blender = rotation_camera_from_site.T @ _BLENDER_FROM_OPENCV.T
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation_site_from_blender, position_m
    stage.camera.matrix_world = Matrix(matrix.tolist())
