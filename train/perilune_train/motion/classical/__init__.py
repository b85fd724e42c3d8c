"""Motion between consecutive frames without training: KLT tracks over a plane, and direct alignment with heights."""
