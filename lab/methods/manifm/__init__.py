"""ManiFM-style grasps: a network names contact points for fingertips, and the hand reaches for them. See `contact_method`."""

from lab.methods.manifm.contact_method import ContactMethod as ContactMethod
