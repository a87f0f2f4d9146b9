"""Pictures and reports that need no browser: grasps and hands on one sheet, and a data set on one page."""
