"""Measurements of the program on the machine at hand: does it keep its pace, and what does a method's error cost?"""
