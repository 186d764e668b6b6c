"""The road from a recording under a PID to a homogeneous PID, and back: did it hold?"""
