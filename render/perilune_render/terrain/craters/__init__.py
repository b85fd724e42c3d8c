"""The crater population: places and sizes, profiles, stamping on the ground, measured rims."""
