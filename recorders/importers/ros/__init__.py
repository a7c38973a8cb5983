"""Importer of ROS 1 and ROS 2 logs, without ROS: .bag, .db3 and MCAP files, and folders of them.

Begin with `importer`.
"""
