"""Networks: plain torch modules that know nothing of datasets or runs."""
