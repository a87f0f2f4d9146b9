"""GenDexGrasp (Li et al. 2023) from scratch: a network invents contact maps of an object, and a descent fits a hand to them."""

from lab.methods.gendexgrasp.map_method import GenDexGrasp as GenDexGrasp
