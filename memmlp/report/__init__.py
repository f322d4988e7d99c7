"""One HTML page of a project's tables, figures and runs."""
