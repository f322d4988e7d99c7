"""The errors that the command line turns into one line and an exit code."""


class InputError(ValueError):
    """Bad user input, told in one line that names the file or key, what is wrong and what is allowed.

    The command line prints it without a traceback and exits with code 2.
    """


class TrainingDiverged(RuntimeError):
    """The loss became NaN or infinite.

    The message is one line with the step, the loss term and the batch's clips. The exit code is 1.
    """
