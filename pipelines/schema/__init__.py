"""The Parquet schema, dataset metadata, splits, labels and selections of scenes."""
