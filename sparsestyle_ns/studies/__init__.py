"""What is found out with many runs: `compare` and `ablate` for the paper's tables, `tradeoff` for time and accuracy.

`study` says what all runs of a study share; `study_page` and `plots` show what was found. `paper_studies` trains whole
runs (`run_queue`, `paper_runs`), each in a process of its own, measures them (`run_figures`) and sets them out.
`tradeoff` trains on a `workbench` in this process, within a `time_budget`: `measure_training` and `measure_rendering`
fill `curves` of error against time, which `advice` and `tradeoff_report` put into words, tables and files.
"""
