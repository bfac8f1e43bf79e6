"""Convert raw drives to Parquet tables."""
