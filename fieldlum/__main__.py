"""The console command, also as `python -m fieldlum`."""

import signal


def main() -> None:
    """Run the command line. Ctrl-C while Python still imports it ends without a traceback."""
    listens = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if listens:  # not in the background of a shell, where SIGINT is ignored
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from fieldlum.cli import main as command

    if listens:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    command(prog_name="fieldlum")


if __name__ == "__main__":
    main()
