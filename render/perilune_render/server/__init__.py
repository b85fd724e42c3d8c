"""A server that renders frames on request, over PANGU's wire protocol and perilune's native interface."""
