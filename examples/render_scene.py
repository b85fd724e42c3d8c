"""Render a labelled descent over a mare, and draw its last frame.

python examples/render_scene.py descent.png [SETTING ...], for example dataset.camera.width_px=512
"""

import sys

import perilune

if len(sys.argv) < 2:
    sys.exit("usage: render_scene.py PICTURE [SETTING ...]")
picture, *settings = sys.argv[1:]
scene = perilune.Scene("mare", seed=7, sun_elevation_deg=20, settings=settings)
frames = scene.render(perilune.descent(n_frames=5))
frames[-1].plot().save(picture)
tilted = scene.render(perilune.look_down(altitude_m=800, tilt_deg=10))
sys.stdout.write(f"{scene}\n{tilted}\nnearest ground {tilted.depth_m.min():.0f} m\n")
