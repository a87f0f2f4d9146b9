"""What proposes candidates: the network, the optimiser, controls, grasp files, and sources of your own."""
