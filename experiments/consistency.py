"""The former name of `jaxlocmap study`."""

import sys

from jaxlocmap.cli.main import main

if __name__ == "__main__":
    sys.argv[0:1] = ["jaxlocmap", "study"]
    main()
