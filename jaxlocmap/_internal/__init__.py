"""What only the compiler asks for: unrolled small matrices, vector sines and random bits, loops under `vmap`."""
