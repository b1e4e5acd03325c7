"""Camera files of all formats that are read: facts of a file, and the camera that they make.

``camera_file`` recognises a file and reads formats of plain text, ``camera_json`` those in JSON,
``camera_fields`` those of ROS, OpenCV and ORB-SLAM. Each gives the ``CameraFacts`` of ``facts``,
which checks them.
"""
