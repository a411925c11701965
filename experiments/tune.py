"""The former name of `jaxlocmap tune`, by which other programs call it."""

import sys

from jaxlocmap.cli.main import main

if __name__ == "__main__":
    sys.argv[0:1] = ["jaxlocmap", "tune"]
    main()
