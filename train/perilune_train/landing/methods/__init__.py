"""All methods of navigation over the descents of a split: tables and pictures."""
