"""Networks: plain torch modules, independent of datasets and runs."""
