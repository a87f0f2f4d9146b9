"""Training of the D(R,O) network, the data engine that feeds it, made hands, and onboarding of a new hand."""
