"""Measurements that other programs wrote, made into sessions."""
