"""`surfkit quality`: the quality report of a survey, as clients of photogrammetry know it, as HTML and PDF."""
