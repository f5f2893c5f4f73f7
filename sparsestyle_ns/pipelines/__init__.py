"""The two methods as nerfstudio pipelines."""
