"""Web pages and servers alike: who may ask, what may be sent, and how a page looks."""
