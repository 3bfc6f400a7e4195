"""`python -m btfpipe`: the command line."""

from btfpipe.cli import main

if __name__ == "__main__":
    main(prog_name="btfpipe")
