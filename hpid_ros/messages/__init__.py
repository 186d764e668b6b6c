"""ROS messages as bytes and arrays: CDR codecs, bags read by columns, bags written."""
