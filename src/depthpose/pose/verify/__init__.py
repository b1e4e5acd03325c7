"""Hypothesis verification: is a refined pose right, and which of its competitors and copies is it?

Each pose is compared with the depth image (``evidence``) and weighed (``probability``) against
others and its symmetric copies (``hypotheses``, ``copies``, ``color``); then status and reason
follow (``decide``), and whether it is this object at all (``identity``).
"""
