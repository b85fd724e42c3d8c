"""The native interface: requests and replies over ZeroMQ's wire protocol."""
