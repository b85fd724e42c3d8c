"""Settings: presets, YAML files and single values resolved into checked sections, and pages about them."""
