"""Show luminance pictures: false-colour PNG, regions, and an offline page."""
