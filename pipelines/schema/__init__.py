"""The Parquet schema, dataset metadata, splits, density labels and selection of scenes."""
