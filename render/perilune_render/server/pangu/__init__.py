"""The server's interface with PANGU's wire protocol."""
