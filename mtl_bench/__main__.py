"""`python -m mtl_bench`: the command line, as the launcher calls it for each cell."""

from mtl_bench.cli.app import main

if __name__ == "__main__":
    main()
