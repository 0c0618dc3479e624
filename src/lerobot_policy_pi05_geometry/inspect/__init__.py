"""Looking inside: what the network attends to, and pictures of it.

attention   the action tokens' attention, read with forward hooks      pictures   figures of a policy at work
page        one HTML file that holds its pictures and videos
"""
