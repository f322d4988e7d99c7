"""`python -m memmlp` and `torchrun -m memmlp`: the command `memmlp`."""

from memmlp.cli.main import main

if __name__ == "__main__":
    main()
