"""A local web page to look at what was reconstructed."""
