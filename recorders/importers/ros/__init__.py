"""Importer of logs of ROS 1 and ROS 2: .bag, .db3 and MCAP files, and folders of them, without ROS.

Begin with `importer`.
"""
