"""Find craters in an image with the installed detector, and draw them.

python examples/find_craters.py docs/pictures/lunar_frame.png craters.png
"""

import sys

import perilune

if len(sys.argv) != 3:
    sys.exit("usage: find_craters.py IMAGE PICTURE")
image, picture = sys.argv[1:]
detector = perilune.load_detector()
craters = detector(image)
craters.plot().save(picture)
largest = craters.table.nlargest(3, "radius_px")
sys.stdout.write(f"{craters}\n{largest[['ellipse_cx_px', 'ellipse_cy_px', 'radius_px', 'score']]}\n")
