"""Rendering with Blender: the only folder that imports bpy."""

try:
    import bpy  # noqa: F401
except ImportError as error:
    raise ImportError(
        f"bpy cannot be loaded ({error}). It needs Python 3.11 (`pip install bpy==4.5.15`) and the system's X11 "
        "libraries; `make setup` checks for both and says which are missing."
    ) from error
