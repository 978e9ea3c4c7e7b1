"""The hard cases of the model as a table, and its run on the user's own device."""
