"""Pictures and reports that need no browser: grasps and hands on one sheet."""
