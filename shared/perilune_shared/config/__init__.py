"""Load configurations from presets, YAML files and single settings; check and print them."""
