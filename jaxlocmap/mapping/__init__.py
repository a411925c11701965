"""Occupancy grids: the cells of a beam, the log-odds update, how good a map is, and ROS map_server files.

`ros.save_map` writes what `ros.load_map` reads: PGM, PNG and other pictures, in the modes trinary, scale and raw.
"""
