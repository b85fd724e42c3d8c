"""Networks: speed of training, inference and suppression; transfer, size and contrast."""
