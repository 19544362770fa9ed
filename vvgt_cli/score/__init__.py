"""Error against run time: runs read from reports, tables, charts, plots and one page that opens offline."""
