"""Run one experiment from its config: python -m experiments.run +exp=breathing."""

from ep2sindy.app.main import main

if __name__ == "__main__":
    main()
