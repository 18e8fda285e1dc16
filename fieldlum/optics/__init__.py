"""Turn camera counts into luminance by direction: exposures, lenses, pictures, profiles."""
