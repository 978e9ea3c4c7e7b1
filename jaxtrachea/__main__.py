"""`python -m jaxtrachea`: the command without its script."""

from jaxtrachea.cli.main import main

if __name__ == "__main__":
    main()
