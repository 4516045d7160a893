"""The sections of a report: each turns what runs have written into elements of a page, and makes no HTML itself."""
