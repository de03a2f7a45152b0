"""The Prefect flow of an experiment. Importing this package imports no Prefect; flows.start sets it up."""
