"""Filters over a recorded log: among landmarks, a map at known poses, scans matched on scans, loops closed."""

from jaxlocmap.replay import landmarks, loops, maps, scans

__all__ = ["landmarks", "loops", "maps", "scans"]
