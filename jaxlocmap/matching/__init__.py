"""Scans matched on a map made of the scans before: normals, the map of lines, one match, submaps in the filter."""
