"""Our own interface: requests and answers, the clients, and the frames of ZeroMQ's protocol."""
