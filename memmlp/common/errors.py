"""The one error that a user's input may raise."""


class InputError(ValueError):
    """Bad user input: one line naming the file or key, what is wrong and what is allowed.

    The command line prints it without a traceback and exits with code 2.
    """


class TrainingDiverged(RuntimeError):
    """The loss became NaN or Inf: one line with the step, the term and the batch's clips; exit code 1."""
