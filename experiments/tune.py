"""The former name of `jaxlocmap tune`."""

import sys

from jaxlocmap.cli.main import main

if __name__ == "__main__":
    sys.argv[0:1] = ["jaxlocmap", "tune"]
    main()
