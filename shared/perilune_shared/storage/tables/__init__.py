"""Read CSV and Parquet tables that are not part of a dataset, with limits. All of them are untrusted."""
