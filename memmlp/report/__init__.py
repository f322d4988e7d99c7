"""Tables, pictures, the HTML page of runs and sweeps, and pages of kept results."""
