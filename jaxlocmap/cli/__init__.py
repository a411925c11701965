"""The command `jaxlocmap`: one module for each of its jobs, on what the library computes. Needs the extra `cli`."""
