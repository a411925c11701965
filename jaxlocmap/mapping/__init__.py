"""Occupancy grids: the cells of a beam, the log-odds update, how good a map is, and ROS map_server files."""
