"""The sections of a quality report, one file for each subject."""
