"""These tests are left out where Blender's module is not installed."""

import importlib.util

collect_ignore_glob = [] if importlib.util.find_spec("bpy") else ["test_*.py"]
