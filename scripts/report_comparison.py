def write_comparison(report, page):
    pass
