"""Read CSV and Parquet tables that are not part of a dataset, under limits. All are untrusted input."""
