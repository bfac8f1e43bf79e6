"""HTML reports, charts, contact sheets and model cards."""
