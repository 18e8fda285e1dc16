"""The console command, also as `python -m fieldlum`."""

import signal


def main() -> None:
    """Run the command line; Ctrl-C during its imports ends the program without a traceback."""
    # False in the background of a shell, where SIGINT is ignored and must remain ignored
    is_interruptible = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if is_interruptible:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from fieldlum.cli import main as command

    if is_interruptible:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    command(prog_name="fieldlum")


if __name__ == "__main__":
    main()
