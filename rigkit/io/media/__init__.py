"""Images, TIFF files and videos."""
