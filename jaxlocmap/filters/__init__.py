"""Filters of a state: `ekf` predicts and corrects, `joseph` is its correction with derivatives written by hand."""
