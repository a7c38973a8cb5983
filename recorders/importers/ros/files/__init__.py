"""Readers of the files of ROS bags, record by record: bag, db3 and MCAP; begin with `bags`."""
