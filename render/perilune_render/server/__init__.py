"""Servers that render frames on request: PANGU's wire protocol, and our own interface."""
