"""Hold what every room uses: errors, records between stages, strict tables, statistics, workers."""
