"""Raw drives to Parquet tables."""
