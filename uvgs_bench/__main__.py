"""``python -m uvgs_bench`` is the ``uvgs`` command."""

from uvgs_bench.cli.app import main

if __name__ == "__main__":
    main()
