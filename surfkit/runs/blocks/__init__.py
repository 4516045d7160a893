"""The blocks of a large scene: planned, tuned apart, merged (CityGaussianV2, sec. 3.3)."""
