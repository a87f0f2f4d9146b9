"""Methods that make grasps, ours, others' and yours, behind one face: `predict(hand, obj, num, seed)`."""
