"""The five processes of HMT-SLAM and the messages between them."""
