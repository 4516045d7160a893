"""A report of runs or of an ablation table: one HTML file that loads nothing from elsewhere."""
