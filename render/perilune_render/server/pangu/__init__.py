"""The interface that uses PANGU's wire protocol."""
