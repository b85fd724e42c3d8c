"""The filter over many random starts, catalogues and inertial errors."""
