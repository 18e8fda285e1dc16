"""Turn camera counts into luminance by direction: photometry, projection, pictures, profiles."""
