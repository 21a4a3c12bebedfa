"""Report: result file, page, pictures and text of an analysis."""
