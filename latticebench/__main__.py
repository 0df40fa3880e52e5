"""`python -m latticebench`: the command line."""

from latticebench.bench.cli import main

if __name__ == "__main__":
    main()
